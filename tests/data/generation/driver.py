"""A run to be killed or interrupted: `python driver.py MANIFEST OUT MESHES JOBS`, with fake samples."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))


def main() -> int:
    """Generate; 130 after Ctrl-C."""
    from ocnf_data.generation import Interrupted, generate
    from ocnf_data.generation.worker import supervisor

    supervisor.DEFAULT_MAKER = "fake_makers:maker"
    manifest, out, meshes, jobs = sys.argv[1:]
    try:
        generate(manifest, out, meshes, int(jobs), progress=False)
    except Interrupted as stop:
        print(stop, flush=True)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
