"""A run to be killed: `python driver.py MANIFEST OUT MESHES JOBS [MAKER]`, of fake samples by default."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))


def main() -> int:
    """Generate; 130 after Ctrl-C."""
    from ocnf_data.generation import Interrupted, generate
    from ocnf_data.generation.worker import supervisor

    manifest, out, meshes, jobs, *maker = sys.argv[1:]
    supervisor.DEFAULT_MAKER = maker[0] if maker else "fake_makers:maker"
    try:
        generate(manifest, out, meshes, int(jobs), progress=False)
    except Interrupted as stop:
        print(stop, flush=True)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
