"""The pictures of an episode, one after the other: what each shows, and what an episode must have for it."""

from matplotlib.figure import Figure

from dataset_tools import demo_figures
from dataset_tools.inspect.cloud import draw_cloud
from dataset_tools.inspect.episodes import Episode
from dataset_tools.inspect.paths import draw_errors, draw_trajectory
from dataset_tools.inspect.views import draw_projections
from dataset_tools.page import Panel
from lerobot_histmv import keys


def keyframe_sheet(episode: Episode) -> Figure:
    """Colours and depth of every view at every keyframe."""
    return demo_figures.contact_sheet(
        [
            demo_figures.Keyframe(
                {camera: (view.color, view.depth) for camera, view in observation.views.items()},
                pose.reason,
                observation.seconds,
                episode.instruction,
            )
            for observation, pose in zip(episode.observations, episode.poses, strict=False)
        ]
    )


def _lacks_positions(episode: Episode) -> str:
    return "a tool position: the curve is joint angles" if episode.is_joints else ""


def _lacks_path(episode: Episode) -> str:
    return "" if episode.motion else "the recorded path: the dense dataset is not at hand"


def _lacks_images(episode: Episode) -> str:
    return "" if episode.cameras else "colour images"


def _lacks_projections(episode: Episode) -> str:
    lacking = _lacks_images(episode) or _lacks_positions(episode)
    if lacking or any(view.calibrated for view in episode.observations[0].views.values()):
        return lacking
    return f"camera calibration: {keys.INTRINSICS} and {keys.EXTRINSICS} whose names tell the camera, such as front.fx"


def _lacks_cloud(episode: Episode) -> str:
    views = episode.observations[0].views.values()
    if any(view.has_cloud for view in views):
        return ""
    if not any(view.depth is not None for view in views):
        return _lacks_images(episode) or f"depth images (<camera>{keys.DEPTH_SUFFIX}, declared with is_depth_map)"
    if not any(view.calibrated for view in views):
        return f"camera calibration: {keys.INTRINSICS} and {keys.EXTRINSICS} whose names tell the camera"
    return "a calibrated view whose depth image is as large as its colour image"


PANELS = (
    Panel(
        "trajectory",
        "Path and keyframes",
        "Numbers count the keyframes; markers tell why each was kept. The dashed lines are what remains of the path.",
        _lacks_positions,
        draw_trajectory,
    ),
    Panel(
        "errors",
        "Error per frame",
        "Distance of every moving frame to the dashed lines. Shaded: the arm rests, so those frames do not count.",
        _lacks_path,
        draw_errors,
    ),
    Panel(
        "keyframes",
        "What was seen at the keyframes",
        "Colours, and depth where there is any (white: no measurement), at each keyframe's observation frame.",
        _lacks_images,
        keyframe_sheet,
    ),
    Panel(
        "projections",
        "The tool in every view",
        "The axes are the measured tool, 3 cm long, and must lie between the finger pads in every view: if they do "
        "not, calibration, tool point or timing is wrong. The white line leads over the next key poses.",
        _lacks_projections,
        draw_projections,
    ),
    Panel(
        "cloud",
        "Merged cloud",
        "All views at the first keyframe. Surfaces that appear twice, or tilted against each other, tell of a wrong "
        "calibration or depth unit.",
        _lacks_cloud,
        draw_cloud,
    ),
)


def left_out(episode: Episode) -> list[str]:
    """A sentence per picture that cannot be drawn, and one about views that a picture leaves out."""
    found = [
        f"{panel.title.lower()}: left out, as the dataset lacks {lacking}"
        for panel in PANELS
        if (lacking := panel.lacking(episode))
    ]
    views = episode.observations[0].views
    bare = [camera for camera, view in views.items() if not view.calibrated]
    if bare and len(bare) < len(views):
        found.append(f"no calibration for {', '.join(bare)}: left out of the projections and the cloud")
    return found
