"""The memory of past steps: what each robot of a batch saw when it last looked, so that a decision encodes one step."""

from collections import deque
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from lerobot_histmv.windows import causal_heat


class Past:
    """Fused maps and tool positions of the last steps of b robots, which need not look at the same times.

    Args:
        robots: b.
        steps: how many steps are kept, the current one included.
    """

    def __init__(self, robots: int, steps: int) -> None:
        self._fused: list[deque[Float[Tensor, "d h w"]]] = [deque(maxlen=steps) for _ in range(robots)]
        self._tools: list[deque[Float[Tensor, " 3"]]] = [deque(maxlen=steps) for _ in range(robots)]

    def __len__(self) -> int:
        return len(self._fused)

    def add_tools(
        self, rows: Sequence[int], tools: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n p 3"], Float[Tensor, "n p"]]:
        """Tool positions [m] of the robots ``rows``, the new ones included, and their heat; 0 heat is padding."""
        for row, tool in zip(rows, tools, strict=True):
            self._tools[row].append(tool)
        positions = [torch.stack(list(self._tools[row])) for row in rows]
        count = torch.tensor([len(each) for each in positions], device=tools.device)
        padded = pad_sequence(positions, batch_first=True)
        age = count[:, None] - 1 - torch.arange(padded.shape[1], device=tools.device)
        return padded, causal_heat(age)

    def add_maps(
        self, rows: Sequence[int], fused: Float[Tensor, "n d h w"]
    ) -> tuple[Float[Tensor, "m d h w"], Bool[Tensor, "n t"]]:
        """The m remembered maps of the robots ``rows``, old to new, the new ones included, and which steps are real."""
        for row, new in zip(rows, fused, strict=True):
            self._fused[row].append(new)
        count = torch.tensor([len(self._fused[row]) for row in rows], device=fused.device)
        real = torch.arange(int(count.max()), device=fused.device) < count[:, None]
        return torch.stack([step for row in rows for step in self._fused[row]]), real
