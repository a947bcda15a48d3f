"""The layout's promises: imports point one way, files and functions stay small, every module says what it is."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("lerobot_histmv", "dataset_tools")
SOURCES = sorted(path.relative_to(ROOT) for package in PACKAGES for path in (ROOT / package).rglob("*.py"))

ENVS = [path for path in SOURCES if path.match("lerobot_histmv/envs/*.py")]
ENVS_WITH_LEROBOT = {"configuration_ur5.py", "processor_ur5.py"}
PURE = {Path("lerobot_histmv/geometry.py"), Path("lerobot_histmv/keys.py"), Path("lerobot_histmv/motion.py")}
KEYFRAMING = {"signals", "fitness", "genetic", "exact", "simplify", "keyframes", "columns", "state", "vectors"}

RULES: dict[str, tuple[list[Path], set[str]]] = {
    "model and geometry know no LeRobot": (
        [path for path in SOURCES if path.parent.parts[1:] == ("model",) or path in PURE],
        {"lerobot", "dataset_tools", "mujoco"},
    ),
    "environments know neither torch nor LeRobot": (
        [path for path in ENVS if path.name not in ENVS_WITH_LEROBOT],
        {"torch", "torchvision", "lerobot"},
    ),
    "the environment's config does not import mujoco": (
        [path for path in ENVS if path.name in ENVS_WITH_LEROBOT],
        {"mujoco", "trimesh", "fast_simplification"},
    ),
    "keyframing knows neither torch nor LeRobot": (
        [path for path in SOURCES if path.parts[0] == "dataset_tools" and path.stem in KEYFRAMING],
        {"torch", "torchvision", "lerobot"},
    ),
    "the policy does not know the dataset tools": (
        [path for path in SOURCES if path.parts[0] == "lerobot_histmv"],
        {"dataset_tools"},
    ),
    "importing the package imports nothing": ([Path("lerobot_histmv/__init__.py")], {"*"}),
}


def imports(path: Path) -> Iterator[str]:
    """Top-level names that ``path`` imports anywhere, also inside functions."""
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition(".")[0]


@pytest.mark.parametrize("rule", RULES)
def test_imports_point_one_way(rule: str) -> None:
    paths, forbidden = RULES[rule]
    assert paths, f"rule {rule!r} matches no file"
    broken = [f"{path}: {name}" for path in paths for name in imports(path) if name in forbidden or "*" in forbidden]
    assert broken == []


@pytest.mark.parametrize(
    ("module_files", "forbidden"),
    [
        (RULES["model and geometry know no LeRobot"][0], "lerobot"),
        (RULES["environments know neither torch nor LeRobot"][0], "torch"),
        (RULES["keyframing knows neither torch nor LeRobot"][0], "torch"),
    ],
    ids=["model without LeRobot", "envs without torch", "keyframing without torch"],
)
def test_nothing_forbidden_arrives_through_others(module_files: list[Path], forbidden: str) -> None:
    modules = [".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in module_files]
    probe = f"import sys, {', '.join(modules)}; print({forbidden!r} in sys.modules)"
    result = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True, cwd=ROOT)
    assert result.stdout.strip() == "False"


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_source_files_are_small_and_documented(path: Path) -> None:
    text = (ROOT / path).read_text()
    tree = ast.parse(text)
    assert text.count("\n") <= 300, "a file has at most 300 lines"
    assert ast.get_docstring(tree), "a module says what it is for"
    functions = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))
    sizes = {node.name: (node.end_lineno or 0) - node.lineno + 1 for node in functions}
    assert {name: size for name, size in sizes.items() if size > 60} == {}, "a function has at most 60 lines"
