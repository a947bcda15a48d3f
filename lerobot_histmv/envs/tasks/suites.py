"""Names of tasks, of their variations, and of the sets in which several are trained and evaluated together.

``turn_tap`` is a task whose variation the seed draws, ``turn_tap.left`` one of its variations, ``set1`` a suite.
"""

from lerobot_histmv.envs.tasks import TASKS
from lerobot_histmv.envs.tasks.base import Task
from lerobot_histmv.envs.tasks.chain import Chain

SUITES: dict[str, tuple[str, ...]] = {
    "set1": (
        "turn_tap.left",
        "turn_tap.right",
        "stack_cups.red",
        "stack_cups.green",
        "stack_cups.blue",
        "pick_and_lift.red",
        "pick_and_lift.green",
        "pick_and_lift.blue",
    ),
    "set2": (
        "take_lid_off_saucepan",
        "open_drawer.bottom",
        "open_drawer.middle",
        "open_drawer.top",
        "insert_onto_square_peg.red",
        "insert_onto_square_peg.green",
        "insert_onto_square_peg.blue",
    ),
    "set3": (
        "reach_target.red",
        "reach_target.green",
        "reach_target.blue",
        "push_buttons.red-green",
        "push_buttons.blue-cyan",
        "push_buttons.yellow-purple",
        "put_item_in_drawer.bottom",
        "put_item_in_drawer.middle",
        "put_item_in_drawer.top",
        "stack_blocks.two-red",
        "stack_blocks.two-green",
        "stack_blocks.two-blue",
    ),
    "unseen": ("pick_and_lift_unseen_colors", "pick_and_lift_unseen_shapes"),
    "all": tuple(name for name in TASKS if not issubclass(TASKS[name], Chain) and "unseen" not in name),
}
"""Paper, section 4.2: three sets that mix simple and complex tasks, up to three variations each. Of its first set,
turning a tap and stacking cups are known, the rest is our choice. Section 4.4: what training does not show. And all
tasks but these and the long-horizon ones."""


def variation_names(name: str) -> list[str]:
    """Names of a task's variations, in order; of one variation, or a task that has only one, the name itself."""
    goals = () if "." in name else TASKS[name].variations
    return [f"{name}.{'-'.join(goal)}" for goal in goals] if len(goals) > 1 else [name]


def find(name: str) -> tuple[type[Task], int | None]:
    """The task of ``name`` and its variation, None if the name leaves it open.

    Raises:
        ValueError: there is no such task or variation.
    """
    task = name.partition(".")[0]
    if task not in TASKS:
        raise ValueError(f"task is {name!r}; accepted are {', '.join(TASKS)}")
    if name == task:
        return TASKS[task], None
    names = variation_names(task)
    if name not in names:
        raise ValueError(f"task is {name!r}; variations of {task} are {', '.join(names)}")
    return TASKS[task], names.index(name)


def expand(names: str) -> list[str]:
    """Tasks and variations in ``names``: tasks, variations and suites joined by commas.

    Raises:
        ValueError: a name is none of these, or one is there twice.
    """
    found: list[str] = []
    for name in (part.strip() for part in names.split(",")):
        if name.partition(".")[0] not in TASKS and name not in SUITES:
            raise ValueError(f"task is {name!r}; accepted are {', '.join(TASKS)}, and the suites {', '.join(SUITES)}")
        found += SUITES.get(name, (name,))
    for name in found:
        find(name)
    if twice := sorted({name for name in found if found.count(name) > 1}):
        raise ValueError(f"task is {names!r}, which names {', '.join(twice)} more than once")
    return found
