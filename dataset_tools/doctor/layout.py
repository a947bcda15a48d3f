"""What a dataset's feature dictionary promises: cameras, calibration, tool pose; and what of it is missing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

from dataset_tools.column_guesses import resolve
from dataset_tools.columns import Column, Columns, ColumnsConfig, Features, entry_names
from dataset_tools.doctor.findings import Finding
from lerobot_histmv import keys


@dataclass(frozen=True)
class Layout:
    """Where a dataset keeps what is checked.

    Attributes:
        rgb: key of the colour image by camera.
        depth: key of the depth image by camera.
        sizes: rows and columns of a camera's images.
        intrinsics: fx, fy, cx, cy by camera.
        extrinsics: the twelve entries of T_world_cam by camera.
        columns: tool pose and gripper; None where they could not be told.
    """

    rgb: Mapping[str, str]
    depth: Mapping[str, str]
    sizes: Mapping[str, tuple[int, int]]
    intrinsics: Mapping[str, Column]
    extrinsics: Mapping[str, Column]
    columns: Columns | None

    @property
    def position(self) -> Column | None:
        """Tool position [m]."""
        return None if self.columns is None or self.columns.is_joints else self.columns.curve


@dataclass(frozen=True)
class Cameras:
    """Image keys by camera: colour, depth declared as such, and colour that is called depth."""

    rgb: dict[str, str] = field(default_factory=dict)
    depth: dict[str, str] = field(default_factory=dict)
    pictures: dict[str, str] = field(default_factory=dict)


def describe(features: Features, depth_keys: Sequence[str], config: ColumnsConfig) -> tuple[Layout, list[Finding]]:
    """Layout of a dataset, and what it lacks."""
    cameras = sort_cameras(features, depth_keys)
    findings = image_findings(features, cameras)
    columns, missing = tool_columns(features, config)
    images = cameras.rgb | {name: key for name, key in cameras.depth.items() if name not in cameras.rgb}
    layout = Layout(
        rgb=cameras.rgb,
        depth=cameras.depth,
        sizes={camera: _size(features, key) for camera, key in images.items()},
        intrinsics=calibration(features, keys.INTRINSICS, keys.INTRINSICS_FIELDS, list(images)),
        extrinsics=calibration(features, keys.EXTRINSICS, keys.EXTRINSICS_FIELDS, list(images)),
        columns=columns,
    )
    findings += [*calibration_findings(features, layout), *missing]
    return layout, findings


def sort_cameras(features: Features, depth_keys: Sequence[str]) -> Cameras:
    """Cameras by kind; a camera's name is its key without ``observation.images.`` and ``_depth``."""
    cameras = Cameras()
    for key in (key for key, feature in features.items() if feature["dtype"] in ("image", "video")):
        name = key.removeprefix(keys.IMAGES_PREFIX)
        if key in depth_keys:
            cameras.depth[name.removesuffix(keys.DEPTH_SUFFIX)] = key
        elif "depth" in name.lower():
            cameras.pictures[name.removesuffix(keys.DEPTH_SUFFIX)] = key
        else:
            cameras.rgb[name] = key
    return cameras


def image_findings(features: Features, cameras: Cameras) -> list[Finding]:
    """What is wrong with the kinds and sizes of images."""
    if not cameras.rgb and not cameras.depth and not cameras.pictures:
        return [Finding.of("no_camera", f"its features are {', '.join(features)}")]
    found = []
    for camera, key in cameras.pictures.items():
        kind = f"{key} is {features[key]['dtype']} of shape {tuple(features[key]['shape'])} without is_depth_map"
        found.append(Finding.of("depth_picture", kind, camera=camera))
    for camera, key in cameras.depth.items():
        if features[key]["dtype"] == "video":
            found.append(Finding.of("depth_video", f"{key} has dtype video", camera=camera))
    for camera, key in cameras.rgb.items():
        if features[key]["dtype"] == "video":
            codec = (features[key].get("info") or {}).get("video.codec", "unknown codec")
            found.append(Finding.of("rgb_lossy", f"{key} is video ({codec})", camera=camera))
        if camera in cameras.depth:
            sizes = _size(features, key), _size(features, cameras.depth[camera])
            if sizes[0] != sizes[1]:
                text = " and depth ".join(f"{height} x {width}" for height, width in sizes)
                found.append(Finding.of("depth_size", f"colour has rows x columns {text}", camera=camera))
        elif camera not in cameras.pictures:
            wanted = f"there is no {key}{keys.DEPTH_SUFFIX} declared with is_depth_map"
            found.append(Finding.of("depth_missing", wanted, camera=camera))
    return found


def calibration(features: Features, feature: str, fields: Sequence[str], cameras: Sequence[str]) -> dict[str, Column]:
    """Entries of a calibration feature by camera, for those cameras that it names in full."""
    names = entry_names(features[feature]) if feature in features and len(features[feature]["shape"]) == 1 else ()
    found = {}
    for camera in cameras:
        wanted = tuple(f"{camera}.{field}" for field in fields)
        if set(wanted) <= set(names):
            found[camera] = Column(feature, tuple(names.index(name) for name in wanted), wanted)
    return found


def calibration_findings(features: Features, layout: Layout) -> list[Finding]:
    """Cameras without calibration."""
    parts = (
        ("intrinsics_missing", keys.INTRINSICS, layout.intrinsics, keys.INTRINSICS_FIELDS),
        ("extrinsics_missing", keys.EXTRINSICS, layout.extrinsics, keys.EXTRINSICS_FIELDS),
    )
    found = []
    for (check, feature, columns, fields), camera in product(parts, layout.sizes):
        if camera not in columns:
            what = f"has no {camera}.{fields[0]} ... {camera}.{fields[-1]}" if feature in features else "does not exist"
            found.append(Finding.of(check, f"{feature} {what}", camera=camera))
    return found


def tool_columns(features: Features, config: ColumnsConfig) -> tuple[Columns | None, list[Finding]]:
    """Columns of the tool's pose, and which of them are missing."""
    try:
        columns = resolve(features, config)
    except ValueError as error:
        return None, [Finding.of("tool_pose_missing", str(error))]
    found = []
    if columns.is_joints:
        found.append(Finding.of("tool_pose_missing", f"told were joints, {columns.curve}"))
    elif columns.rotation is None:
        found.append(Finding.of("tool_pose_missing", f"there is a position, {columns.curve}, but no rotation"))
    elif columns.commanded is None:
        names = entry_names(features[keys.ACTION]) if keys.ACTION in features else ()
        found.append(Finding.of("action_pose_missing", f"action has {', '.join(names) or 'no names'}"))
    return columns, found


def _size(features: Features, key: str) -> tuple[int, int]:
    """Rows and columns of an image feature, whose shape may begin or end with its channels."""
    first, second, third = features[key]["shape"]
    return (second, third) if first in (1, 3) else (first, second)
