"""Settings for all tests: offline, headless, one thread, no user's files touched, array shapes checked.

The environment is set before anything heavy is imported, here, because LeRobot and mujoco read it on import.
"""

import atexit
import os
import shutil
import tempfile

from jaxtyping import install_import_hook

SCRATCH = tempfile.mkdtemp(prefix="histmv-tests-")
atexit.register(shutil.rmtree, SCRATCH, ignore_errors=True)

os.environ |= {
    "HF_HUB_OFFLINE": "1",
    "HF_HOME": f"{SCRATCH}/huggingface",
    "HISTMV_CACHE": f"{SCRATCH}/cache",
    "HF_LEROBOT_HOME": f"{SCRATCH}/lerobot",
    "HF_DATASETS_DISABLE_PROGRESS_BARS": "1",
    "MPLBACKEND": "agg",
    "WANDB_MODE": "disabled",
    "OMP_NUM_THREADS": "1",
    "LP_NUM_THREADS": "1",
    "TOKENIZERS_PARALLELISM": "false",
}
os.environ.setdefault("MUJOCO_GL", "egl")

SHAPES_CHECKED = ["lerobot_histmv.geometry", "lerobot_histmv.model", "lerobot_histmv.data", "dataset_tools"]
install_import_hook(SHAPES_CHECKED, "beartype.beartype")
