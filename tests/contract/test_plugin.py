"""LeRobot finds the plugin in a fresh process, and a broken plugin cannot pass unnoticed."""

import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]

DISCOVER = """
import io, json, logging, sys
log = io.StringIO()
logging.basicConfig(stream=log, level=logging.WARNING)
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
import lerobot_histmv
print(json.dumps({
    "policies": sorted(PreTrainedConfig.get_known_choices()),
    "envs": sorted(EnvConfig.get_known_choices()),
    "log": log.getvalue(),
    "heavy": [name for name in ("mujoco", "open_clip", "timm", "dataset_tools") if name in sys.modules],
    "package": lerobot_histmv.__file__,
}))
"""


def discover(folder: Path) -> dict[str, Any]:
    """What a fresh process, started in ``folder``, which is then first on its path, knows after LeRobot's search."""
    result = subprocess.run(
        [sys.executable, "-c", DISCOVER],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    found: dict[str, Any] = json.loads(result.stdout.splitlines()[-1])
    return found


def failures(found: dict[str, Any]) -> list[str]:
    """Plugins that LeRobot could not import: it only logs them."""
    return [line for line in found["log"].splitlines() if "Could not import third-party plugin" in line]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built without isolation so that nothing is fetched."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return path


def test_editable_install_registers_both_and_a_broken_plugin_is_seen(tmp_path: Path) -> None:
    info = tmp_path / "lerobot_policy_broken-0.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_policy_broken\nVersion: 0.0\n")
    (tmp_path / "lerobot_policy_broken.py").write_text("import a_module_that_does_not_exist\n")
    found = discover(tmp_path)
    assert Path(found["package"]) == ROOT / "lerobot_histmv" / "__init__.py"
    assert failures(found) == ["ERROR:root:Could not import third-party plugin: lerobot_policy_broken"], found["log"]
    assert "histmv" in found["policies"]
    assert "ur5" in found["envs"]
    assert found["heavy"] == []


def test_wheel_registers_policy_and_environment(wheel: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    found = discover(tmp_path)
    assert Path(found["package"]).is_relative_to(tmp_path)
    assert failures(found) == [], found["log"]
    assert "histmv" in found["policies"]
    assert "ur5" in found["envs"]


def test_wheel_carries_raw_name_alias_module_configs_and_command(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        info = next(name.rpartition("/")[0] for name in names if name.endswith("/METADATA"))
        metadata = archive.read(f"{info}/METADATA").decode()
        commands = archive.read(f"{info}/entry_points.txt").decode()
    assert "\nName: lerobot_policy_histmv\n" in metadata
    assert "histmv = dataset_tools.cli:main" in commands
    expected = {"lerobot_policy_histmv.py", "lerobot_histmv/_plugin.py", "dataset_tools/configs/train/default.yaml"}
    assert expected <= set(names)
    assert {name.partition("/")[0] for name in names} == {
        "lerobot_histmv", "dataset_tools", "lerobot_policy_histmv.py", info,
    }  # fmt: skip


def test_training_does_not_require_mujoco(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        info = next(name for name in archive.namelist() if name.endswith("/METADATA"))
        lines = archive.read(info).decode().splitlines()
    required = [line for line in lines if line.startswith("Requires-Dist:") and "extra ==" not in line]
    assert not [line for line in required if "mujoco" in line or "sscbirrt" in line]
    assert [line for line in required if "lerobot[" in line]


def test_importing_the_package_is_instant() -> None:
    probe = "import sys; old = set(sys.modules); import lerobot_histmv; print(*sorted(set(sys.modules) - old))"
    result = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["lerobot_histmv"]
