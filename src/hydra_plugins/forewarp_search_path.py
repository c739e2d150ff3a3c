"""Put the ``conf/`` of installed packages on the search path of forewarp's commands."""

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin


class InstalledPackages(SearchPathPlugin):
    """Adds the ``conf/`` of each package that declares an entry point, behind ours, whose files win."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Extend a path that begins at our ``conf/``; leave other applications' paths as they are."""
        # Not above: Hydra reads this file in every application.
        from forewarp.runs.config_files import installed, project_root

        main = [part.path for part in search_path.get_path() if part.provider == "main"]
        try:
            ours = str(project_root() / "conf")
        except ValueError:  # there is none: this is another application
            return
        if main and main[0].removeprefix("file://") == ours:
            for package, folder in installed().items():
                search_path.append(package, f"file://{folder}")
