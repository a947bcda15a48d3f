"""Bad input gets a ValueError that names the thing: datasets, configurations and single observations."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from tiny_policy import CAMERAS, STATE_SIZE, TASK, episode, observation, stack, tiny_config, tiny_policy, window
from tiny_scene import SIZE

from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig

JOINTS = [f"joint_{i}.pos" for i in range(STATE_SIZE - len(keys.POSE_NAMES))]
FRONT, DEPTH = keys.rgb_key("front"), keys.depth_key("front")


def dataset_features() -> dict[str, Any]:
    """Features of a dataset that histmv accepts, as LeRobot's metadata states them."""

    def vector(names: list[str]) -> dict[str, Any]:
        return {"dtype": "float32", "shape": (len(names),), "names": names}

    features = {
        keys.ACTION: vector(list(keys.POSE_NAMES)),
        keys.STATE: vector([*keys.POSE_NAMES, *JOINTS]),
        keys.INTRINSICS: vector(keys.intrinsics_names(CAMERAS)),
        keys.EXTRINSICS: vector(keys.extrinsics_names(CAMERAS)),
    }
    for camera in CAMERAS:
        features[keys.rgb_key(camera)] = {
            "dtype": "image",
            "shape": (*SIZE, 3),
            "names": ["height", "width", "channels"],
        }
        features[keys.depth_key(camera)] = {
            "dtype": "image",
            "shape": (*SIZE, 1),
            "names": ["height", "width", "channels"],
        }
    return features


def test_cameras_and_their_order_are_read_from_the_dataset() -> None:
    config = tiny_config(cameras=[])
    config.set_dataset_feature_metadata(dataset_features())
    assert config.cameras == CAMERAS


def rename(key: str, change: Callable[[list[str]], list[str] | None]) -> Callable[[dict[str, Any]], None]:
    def spoil(features: dict[str, Any]) -> None:
        features[key]["names"] = change(features[key]["names"])

    return spoil


def xyzw(names: list[str]) -> list[str]:
    return [*names[:3], *names[4:7], names[3], *names[7:]]


SPOILT_DATASETS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no intrinsics": (lambda f: f.pop(keys.INTRINSICS), r"camera calibration.*observation\.camera_intrinsics"),
    "no extrinsics": (lambda f: f.pop(keys.EXTRINSICS), r"camera calibration.*observation\.camera_extrinsics"),
    "quaternions xyzw in the action": (rename(keys.ACTION, xyzw), r"action.*ee\.qx\.pos.*needs.*ee\.qw\.pos"),
    "quaternions xyzw in the state": (rename(keys.STATE, xyzw), r"observation\.state.*ee\.qx\.pos"),
    "unnamed action": (rename(keys.ACTION, lambda names: None), r"action.*\[\].*needs"),
    "no state": (lambda f: f.pop(keys.STATE), r"observation\.state.*\[\].*needs"),
    "joint action": (rename(keys.ACTION, lambda names: JOINTS), r"action.*joint_0\.pos"),
    "cameras in different orders": (
        rename(keys.EXTRINSICS, lambda names: keys.extrinsics_names(CAMERAS[::-1])),
        r"camera_extrinsics has names \['wrist",
    ),
    "intrinsics in another order": (rename(keys.INTRINSICS, lambda names: names[::-1]), r"camera_intrinsics has names"),
    "unnamed intrinsics": (rename(keys.INTRINSICS, lambda names: None), r"camera_intrinsics has names None"),
    "unnamed extrinsics": (rename(keys.EXTRINSICS, lambda names: None), r"camera_extrinsics has names None"),
}


@pytest.mark.parametrize("case", SPOILT_DATASETS)
def test_datasets_that_would_be_misread_are_refused(case: str) -> None:
    spoil, message = SPOILT_DATASETS[case]
    features = deepcopy(dataset_features())
    spoil(features)
    with pytest.raises(ValueError, match=message):
        tiny_config(cameras=[]).set_dataset_feature_metadata(features)


def test_dataset_with_other_cameras_than_the_checkpoint_s_is_refused() -> None:
    with pytest.raises(ValueError, match=r"policy\.cameras=\['wrist', 'front'\].*\['front', 'wrist'\]"):
        tiny_config(cameras=CAMERAS[::-1]).set_dataset_feature_metadata(dataset_features())


def drop(key: str) -> Callable[[HistMVConfig], None]:
    return lambda config: config.input_features.pop(key) and None


def resize(key: str, *shape: int) -> Callable[[HistMVConfig], None]:
    return lambda config: config.input_features.update({key: PolicyFeature(FeatureType.VISUAL, shape)})


SPOILT_CONFIGS: dict[str, tuple[Callable[[HistMVConfig], Any], str]] = {
    "no depth": (drop(DEPTH), r"needs \['observation\.images\.front_depth'\].*lacks"),
    "no colour": (drop(FRONT), r"needs \['observation\.images\.front'\].*lacks"),
    "no state": (drop(keys.STATE), r"needs \['observation\.state'\].*lacks"),
    "no intrinsics": (drop(keys.INTRINSICS), r"needs \['observation\.camera_intrinsics'\].*lacks"),
    "no camera": (lambda config: config.cameras.clear(), r"policy\.cameras is empty"),
    "views of two sizes": (resize(FRONT, 3, 64, 64), r"one size.*\(32, 48\).*\(64, 64\)"),
    "depth of another size": (resize(DEPTH, 1, 64, 64), r"one size"),
    "calibration of three cameras": (resize(keys.INTRINSICS, 12), r"camera_intrinsics has shape \(12,\); 2 cameras"),
    "action of seven numbers": (
        lambda config: config.output_features.update({keys.ACTION: PolicyFeature(FeatureType.ACTION, (7,))}),
        r"action must have the 8 components",
    ),
    "no action": (lambda config: config.output_features.clear(), r"action must have the 8 components"),
    "sides that cannot be halved": (
        lambda config: [resize(key, *f.shape[:1], 40, 40)(config) for key, f in config.image_features.items()],
        r"40 x 40 pixels.*multiples of 16",
    ),
}


@pytest.mark.parametrize("case", SPOILT_CONFIGS)
def test_policies_that_lack_an_input_are_refused(case: str) -> None:
    spoil, message = SPOILT_CONFIGS[case]
    config = tiny_config()
    spoil(config)
    with pytest.raises(ValueError, match=message):
        tiny_policy(config)


def test_normalisation_by_statistics_is_refused() -> None:
    with pytest.raises(ValueError, match=r"normalization_mapping=.*use IDENTITY"):
        tiny_config(normalization_mapping={"STATE": NormalizationMode.MEAN_STD})


def put(key: str, value: float, *where: Any) -> Callable[[dict[str, Any]], None]:
    def spoil(batch: dict[str, Any]) -> None:
        batch[key] = batch[key].clone()
        batch[key][(..., *where)] = value

    return spoil


def scale(key: str, factor: float) -> Callable[[dict[str, Any]], None]:
    return lambda batch: batch.update({key: batch[key] * factor})


def blind(batch: dict[str, Any]) -> None:
    """No camera has depth."""
    for camera in ("front", "wrist"):
        scale(keys.depth_key(camera), 0.0)(batch)


SPOILT_OBSERVATIONS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "missing camera": (lambda b: b.pop(FRONT), r"lacks 'observation\.images\.front'.*\['front', 'wrist'\]"),
    "missing depth": (lambda b: b.pop(DEPTH), r"lacks 'observation\.images\.front_depth'"),
    "missing state": (lambda b: b.pop(keys.STATE), r"lacks 'observation\.state'"),
    "missing intrinsics": (lambda b: b.pop(keys.INTRINSICS), r"lacks 'observation\.camera_intrinsics'"),
    "missing extrinsics": (lambda b: b.pop(keys.EXTRINSICS), r"lacks 'observation\.camera_extrinsics'"),
    "NaN in state": (put(keys.STATE, torch.nan, 9), r"observation\.state holds NaN"),
    "infinite state": (put(keys.STATE, torch.inf, 0), r"observation\.state holds NaN or infinity"),
    "NaN in depth": (put(DEPTH, torch.nan, 3, 5), r"front_depth holds NaN"),
    "infinite depth": (put(DEPTH, torch.inf, 3, 5), r"front_depth holds NaN or infinity"),
    "NaN in extrinsics": (put(keys.EXTRINSICS, torch.nan, 3), r"camera_extrinsics holds NaN"),
    "NaN in colours": (put(FRONT, torch.nan, 3, 5), r"observation\.images\.front holds NaN"),
    "depth in metres": (scale(DEPTH, 1e-3), r"front_depth.*looks like metres.*millimetres"),
    "no valid depth": (blind, r"no camera of \['front', 'wrist'\] has any valid depth"),
    "quaternion of norm 4": (
        put(keys.STATE, 2.0, slice(3, 7)),
        r"observation\.state.*quaternion of norm 4.*w, x, y, z",
    ),
    "gripper in percent": (put(keys.STATE, 87.0, 7), r"observation\.state.*gripper\.pos of 87.*0 \(closed\) to 1"),
    "gripper a little too far open": (put(keys.STATE, 1.06, 7), r"observation\.state.*gripper\.pos of 1\.06"),
    "zero quaternion": (put(keys.STATE, 0.0, slice(3, 7)), r"observation\.state.*quaternion of norm 0"),
    "colours of 0 to 255": (scale(FRONT, 255.0), r"observation\.images\.front.*\[0, 1\]"),
    "focal length of 0": (put(keys.INTRINSICS, 0.0, 0), r"camera_intrinsics.*focal"),
    "extrinsics that do not rotate": (put(keys.EXTRINSICS, 2.0, 0), r"camera_extrinsics.*rotation"),
}


@pytest.mark.parametrize("where", ["observation", "window"])
@pytest.mark.parametrize("case", SPOILT_OBSERVATIONS)
def test_observations_that_would_be_misread_are_refused(case: str, where: str) -> None:
    """The same checks guard a training window and a single observation, in whichever row of the batch it is."""
    rows = episode(3)
    good, bad = (
        (observation(rows, 0), observation(rows, 1)) if where == "observation" else (window(rows, 0), window(rows, 2))
    )
    before, _ = make_pre_post_processors(tiny_config())
    spoil, message = SPOILT_OBSERVATIONS[case]
    before(stack([good, bad]))
    spoil(bad)
    batch = stack([{key: values for key, values in good.items() if key in bad}, bad])
    with pytest.raises(ValueError, match=message):
        before(batch)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (put(keys.ACTION, torch.nan, 1), r"action holds NaN"),
        (put(keys.ACTION, 0.0, slice(3, 7)), r"action holds a quaternion of norm 0"),
        (put(keys.ACTION, -1.0, 7), r"action holds a gripper\.pos of -1.*0 \(closed\) to 1"),
    ],
    ids=["NaN", "zero quaternion", "signed gripper"],
)
def test_targets_that_would_spoil_the_weights_are_refused(
    spoil: Callable[[dict[str, Any]], None], message: str
) -> None:
    batch = window(episode(3), 2)
    spoil(batch)
    before, _ = make_pre_post_processors(tiny_config())
    with pytest.raises(ValueError, match=message):
        before(batch)


def test_a_dead_camera_is_left_out_with_one_warning(caplog: pytest.LogCaptureFixture) -> None:
    rows = episode(3)
    before, after = make_pre_post_processors(tiny_config())
    policy = tiny_policy(tiny_config()).eval()
    dead = observation(rows, 0)
    scale(DEPTH, 0.0)(dead)
    scale(FRONT, 0.0)(dead)
    for _ in range(2):
        action = after(policy.select_action(before(stack([dead]))))
    assert action.isfinite().all()
    assert policy.last_decision.view.tolist() == [policy.config.cameras.index("wrist")]
    assert [record.message for record in caplog.records if "without any depth" in record.message] == [
        "front has images without any depth (all 0): decisions leave them out"
    ]


def test_good_input_passes_unchanged_but_for_the_type_of_depth() -> None:
    before, _ = make_pre_post_processors(tiny_config())
    batch = window(episode(3), 2)
    batch[DEPTH] = batch[DEPTH].to(torch.uint16)
    checked = before(batch)
    assert checked[DEPTH].dtype == torch.float32
    for key, values in batch.items():
        if isinstance(values, torch.Tensor):
            torch.testing.assert_close(checked[key], values, check_dtype=False)
    assert checked["task"] == [TASK]


def test_one_observation_without_a_batch_axis_gets_one() -> None:
    before, after = make_pre_post_processors(tiny_config())
    single = {key: values[0] for key, values in observation(episode(1), 0).items()}
    batch = before(single)
    assert after(tiny_policy().select_action(batch)).shape == (1, 8)


def test_calibration_of_more_cameras_than_the_policy_has_is_refused() -> None:
    before, _ = make_pre_post_processors(tiny_config())
    batch = observation(episode(3), 0)
    batch[keys.INTRINSICS] = torch.cat([batch[keys.INTRINSICS]] * 2, dim=-1)
    with pytest.raises(ValueError, match=r"camera_intrinsics.*16.*\['front', 'wrist'\]"):
        before(batch)
