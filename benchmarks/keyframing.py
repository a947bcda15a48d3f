"""Keyframes of recorded episodes: gap to the exact optimum, time, share of the genetic algorithm's frames, replay.

    python benchmarks/keyframing.py ROOT [ROOT ...]

Each ROOT is a dataset that ``histmv record`` made. Writes ``benchmarks/results/keyframing.json``.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results" / "keyframing.json"
REPORT = "meta/keyframing.json"


def measure(root: Path) -> dict[str, Any]:
    """Totals of the keyframing of one dataset, all its episodes replayed."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "keyframes"
        told = json.loads((root / "meta" / "recording.json").read_text())
        command = (
            "histmv", "keyframe", "--dataset.repo_id=local/benchmark", f"--dataset.root={root}",
            "--output.repo_id=local/benchmark_keyframes", f"--output.root={output}", "--replay=flag",
        )  # fmt: skip
        subprocess.run([str(Path(sys.executable).parent / command[0]), *command[1:]], check=True)
        return {"task": told["settings"]["task"], **json.loads((output / REPORT).read_text())["totals"]}


def main() -> None:
    """Measure every dataset given and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("roots", nargs="+", type=Path, metavar="ROOT")
    figures = [measure(root) for root in parser.parse_args().roots]
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(
        json.dumps({"command": "python benchmarks/keyframing.py ROOT ...", "datasets": figures}, indent=2) + "\n"
    )
    print(f"written to {RESULTS}")


if __name__ == "__main__":
    main()
