"""One step of the build that pyproject.toml has no word for: `manifests/` goes into the wheel.

The folder stays at the root of the repository, and `ocnf_data.manifest.shipped` reads it there; a wheel has
no root, so it holds a copy as `ocnf_data/manifests/`. An editable install needs none.

(A mapping in `package-dir` would do for wheels, but turns editable installs into import hooks that type
checkers cannot follow; `data-files` land outside of the package, where it cannot find them.)
"""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

MANIFESTS = sorted(str(path) for path in Path("manifests").glob("*.yaml"))


class BuildWithManifests(build_py):
    """`build_py`, and the manifests beside the modules."""

    def run(self) -> None:
        """Build the modules; then copy the manifests, unless the install is editable."""
        super().run()
        if not self.editable_mode:
            for source, target in zip(MANIFESTS, self._targets(), strict=True):
                self.mkpath(str(Path(target).parent))
                self.copy_file(source, target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        """What is built."""
        return [*super().get_outputs(include_bytecode), *([] if self.editable_mode else self._targets())]

    def get_source_files(self) -> list[str]:
        """What it is built from: this is how the manifests get into a source distribution."""
        return [*super().get_source_files(), *MANIFESTS]

    def _targets(self) -> list[str]:
        return [str(Path(self.build_lib, "ocnf_data", path)) for path in MANIFESTS]


setup(cmdclass={"build_py": BuildWithManifests})
