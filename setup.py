"""Put the configurations, which lie at the top of the repository, into the wheel as package data."""

from pathlib import Path
from shutil import rmtree

from setuptools import setup
from setuptools.command.build_py import build_py

FOLDERS = ("conf", "sweeps")


class WithConfigurations(build_py):
    """Build, and copy the folders beside the modules; an editable install uses them where they are."""

    def run(self):
        """Leave nothing there of an earlier build, whose modules may have moved since."""
        if not self.editable_mode:
            for package in ("forewarp", "hydra_plugins"):
                rmtree(Path(self.build_lib, package), ignore_errors=True)
        super().run()
        if not self.editable_mode:
            for file in self._configurations():
                target = Path(self.build_lib, "forewarp", file)
                self.mkpath(str(target.parent))
                self.copy_file(file, str(target))

    def get_source_files(self):
        """All that goes into a source distribution too."""
        return super().get_source_files() + self._configurations()

    def _configurations(self):
        return [str(file) for folder in FOLDERS for file in sorted(Path(folder).rglob("*.yaml"))]


setup(cmdclass={"build_py": WithConfigurations})
