"""Budgeted training: a checkpoint falls on every asked minute, and its time is training time, whatever is killed."""

import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def timed() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        import timed_training

        yield timed_training


@settings(deadline=None)
@given(st.sets(st.integers(1, 130), min_size=1, max_size=5), st.floats(0.05, 20))
def test_wanted_minutes_fall_on_checkpoints_and_fit_the_budget(
    timed: ModuleType, minutes: set[int], pace: float
) -> None:
    plan = timed.Plan.of(minutes, pace)
    assert all(step % plan.save_freq == 0 for step in plan.wanted())
    assert plan.wanted()[-1] == plan.steps
    for minute, step in zip(sorted(minutes), plan.wanted(), strict=True):
        rounding = pace * step / plan.save_freq / 2
        assert abs(step * pace - 60 * minute) <= rounding + 1e-6


@pytest.mark.parametrize("minutes", [(5, 10, 15, 25), (15, 30, 60, 120), (7,), (60, 120)])
def test_a_kill_loses_little(timed: ModuleType, minutes: tuple[int, ...]) -> None:
    plan = timed.Plan.of(minutes, 1.0)
    assert plan.save_freq * plan.seconds_per_step <= 60 * timed.SAVE_MINUTES


class Watch:
    """A time that the test moves."""

    seconds = 1000.0

    def __call__(self) -> float:
        return self.seconds


def test_the_clock_goes_on_where_the_last_checkpoint_was(timed: ModuleType, tmp_path: Path) -> None:
    plan, now = timed.Plan.of((1, 2), 5.0), Watch()
    assert (plan.steps, plan.save_freq) == (24, 12)
    first = timed.Clock(tmp_path, plan, 0, now)
    first.tick(3, 17)
    now.seconds += 300
    first.tick(0, 24)
    now.seconds += 100  # another bar and starting are no training: the first step counts as it was measured
    for step in range(1, 20):
        first.tick(step, 24)
        now.seconds += 6
    assert first.reached == {12: 5.0 + 11 * 6}
    # Killed after step 19: what came after the checkpoint at 12 was for nothing.
    now.seconds += 9999
    second = timed.Clock(tmp_path, plan, 12, now)
    for done in range(13):
        second.tick(done, 12)
        now.seconds += 4
    assert second.reached == {12: 71.0, 24: 71.0 + 5.0 + 11 * 4}
    assert json.loads((tmp_path / timed.CLOCK).read_text()) == {"12": 71.0, "24": 120.0}


def test_times_of_checkpoints_that_were_never_written_are_forgotten(timed: ModuleType, tmp_path: Path) -> None:
    plan, now = timed.Plan.of((1, 2), 5.0), Watch()
    lost = timed.Clock(tmp_path, plan, 0, now)
    lost.tick(1, 24)
    now.seconds += 50
    lost.tick(13, 24)  # a bar that jumps still finds the checkpoint at 12
    assert lost.reached == {12: 55.0}
    assert timed.Clock(tmp_path, plan, 0, now).reached == {}


def test_a_training_slower_than_planned_is_stopped(timed: ModuleType, tmp_path: Path) -> None:
    plan, now = timed.Plan.of((1, 2), 5.0), Watch()
    clock = timed.Clock(tmp_path, plan, 0, now)
    clock.tick(1, 24)
    now.seconds += plan.seconds() - plan.seconds_per_step - 1
    clock.tick(11, 24)
    now.seconds += 2
    with pytest.raises(timed.EnoughError):
        clock.tick(12, 24)
    clock.tick(24, 24)  # finished: the last checkpoint is being written


def test_the_probe_skips_the_first_steps(timed: ModuleType) -> None:
    now = Watch()
    probe = timed.Probe(now)
    with pytest.raises(timed.EnoughError):
        for step in range(1000):
            now.seconds += 100 if step <= timed.PROBE_WARM_UP else 7
            probe.tick(step, timed.PROBE_STEPS)
    assert probe.seconds_per_step == 7


def test_only_what_evaluation_and_resuming_need_is_kept(timed: ModuleType, tmp_path: Path) -> None:
    training = timed.TimedTraining.__new__(timed.TimedTraining)
    training.training, training.plan = tmp_path, timed.Plan((1, 3), 1.0, 6, 1)
    for step in range(1, 6):
        for part in ("pretrained_model", "training_state"):
            (timed.checkpoint(tmp_path, step) / part).mkdir(parents=True)
    (tmp_path / "checkpoints" / "last").symlink_to("000004")
    assert timed.newest_step(tmp_path) == 4
    training._forget_older(4)
    left = sorted(str(path.relative_to(tmp_path / "checkpoints")) for path in tmp_path.glob("checkpoints/0*/*"))
    assert left == [
        "000002/pretrained_model",
        "000004/pretrained_model",
        "000004/training_state",
        "000005/pretrained_model",  # being written
        "000005/training_state",
    ]
