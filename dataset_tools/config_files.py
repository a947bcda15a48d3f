"""Finds the project's YAML files, in a checkout as well as in an installed wheel."""

from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


@dataclass
class ConfigsConfig:
    """Print the path of one YAML file, or all names with their folder."""

    # name of a file without its ending, such as train/demo; empty lists them all
    name: str = ""


def folder() -> Path:
    """The folder of YAML files: inside the installed package, or at the top of the checkout."""
    installed = PACKAGE / "configs"
    return installed if installed.is_dir() else PACKAGE.parent / "configs"


def names() -> list[str]:
    """Names of all YAML files, such as ``train/demo``."""
    return sorted(str(path.relative_to(folder()).with_suffix("")) for path in folder().rglob("*.yaml"))


def find(name: str) -> Path:
    """Path of the YAML file called ``name``.

    Raises:
        ValueError: no file has this name; the message lists those that exist.
    """
    path = folder() / f"{name}.yaml"
    if not path.is_file():
        raise ValueError(f"no config named {name!r}; there are {', '.join(names())}")
    return path


def run(config: ConfigsConfig) -> None:
    """Print the path of ``config.name``, or what there is."""
    if config.name:
        print(find(config.name))
        return
    print(f"in {folder()}:")
    for name in names():
        print(f"  {name}")
