"""The HistMV policy: windows, loss and the memory of past steps around ``HistMVNet``."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from einops import rearrange
from huggingface_hub import ModelCard
from jaxtyping import Float, Int
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from lerobot_histmv import keys
from lerobot_histmv.chance import drawn_from
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.control import HeldStep
from lerobot_histmv.data.instructions import load_paraphrases, meanings
from lerobot_histmv.decision import Decision
from lerobot_histmv.model import augment, losses
from lerobot_histmv.model.history import Lookback
from lerobot_histmv.model.layers import full_precision, masked_mean
from lerobot_histmv.model.network import Encoding, HistMVNet
from lerobot_histmv.model.view_attention import ViewAttention, best_shares, choice_loss, ranking_loss
from lerobot_histmv.model_card import model_card
from lerobot_histmv.past import Past
from lerobot_histmv.windows import Window, look_back, read_window

Batch = dict[str, Any]
MEANINGS = 12
"""Instructions that one training step tells apart."""
FUSED = ("cpu", "cuda")
"""Devices for which torch has fused optimizers."""


class HistMVPolicy(PreTrainedPolicy):
    """LeRobot policy ``histmv``: one action is the key pose that the next macro step moves to."""

    config_class = HistMVConfig
    name = "histmv"
    _fsdp_wrap_modules: ClassVar[list[str]] = ["ResidualAttentionBlock", "SelfAttentionBlock"]
    """Classes that sharded training splits: the layers of a trained CLIP tower and of the history transformer. LeRobot
    reads them from 0.6.2 on. With frozen towers there is nothing worth sharding, and no layer of the first kind."""

    def __init__(self, config: HistMVConfig, dataset_meta: Any = None, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        if dataset_meta is not None:  # what the configuration or a checkpoint knows stays
            config.instructions = load_paraphrases(dataset_meta.root, dataset_meta.tasks.index) | config.instructions
        self.net = HistMVNet(config.network, config.image_size)
        self._meanings = meanings(config.instructions)
        self._warned: set[str] = set()
        self.reset()

    @classmethod
    def _load_as_safetensor(
        cls, model: "HistMVPolicy", model_file: str, map_location: str, strict: bool
    ) -> "HistMVPolicy":
        """Load weights, always strictly: LeRobot would only log what is missing and act with random weights.

        Raises:
            ValueError: the checkpoint was made with another configuration.
        """
        try:
            return super()._load_as_safetensor(model, model_file, map_location, strict=True)
        except RuntimeError as error:
            raise ValueError(
                f"checkpoint {model_file} was made with another configuration, or by an older version (CHANGELOG.md "
                f"tells what such checkpoints need): {error}"
            ) from error

    def generate_model_card(
        self,
        dataset_repo_id: str,
        model_type: str,
        license: str | None,
        tags: list[str] | None,
        cfg: Any = None,
        dataset_meta: Any = None,
    ) -> ModelCard:
        """What LeRobot uploads as README.md with ``--policy.push_to_hub=true``; see ``model_card``."""
        return model_card(self.config, cfg, dataset_meta, license, tags)

    def get_optim_params(self) -> Any:
        """One group of all trainable parameters.

        A fused step takes an eighth of the time on a CPU: most of 200 small tensors and CLIP's table of 49,408 tokens.
        """
        trained = [parameter for parameter in self.parameters() if parameter.requires_grad]
        return [{"params": trained, "fused": all(parameter.device.type in FUSED for parameter in trained)}]

    def reset(self) -> None:
        """Forget all past steps and held targets; call it whenever the environments are reset."""
        self._past: Past | None = None
        self._held: list[HeldStep] = []
        self._heard: dict[str, Tensor] = {}
        self.last_decision: Decision | None = None

    def forward(self, batch: Batch, reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Loss over every row of the windows whose whole history is there, each row of the dataset counting once.

        Args:
            batch: 2s + 1 rows around each drawn row, as LeRobot's loader and the preprocessor give them.
            reduction: "mean" for a scalar, "none" for one loss per window.
        """
        with drawn_from(batch.get(keys.ROW) if self.training else None):
            return self._loss(batch, reduction)

    def _loss(self, batch: Batch, reduction: str) -> tuple[Tensor, dict[str, float]]:
        config = self.config
        window = read_window(batch, config.cameras, self.net.semantics.stored_as)
        sentences = self._paraphrase(batch["task"]) if self.training else batch["task"]
        text = self.net.semantics.text(sentences, window.real.device)
        with full_precision(window.depth):
            if self.training:
                window = self._augment(window)
            seen = window.observe(text)
        options = config.network.views
        choice = options.train_choice if self.training and options.decode == "one" else "best"
        lookback, rows = look_back(window.real)
        encoding, predicted, views, shares = self.net(seen, lookback, choice)

        step, view = views.unbind(-1)
        target, text = window.target[lookback.decided], seen.text[lookback.decided]
        terms = losses.action_losses(predicted, target[step], *self.net.heat_cloud(encoding, views), config.loss)
        # Views are judged by their actions alone: one that shows nothing near the target has no heat map loss at all.
        acted = losses.weighted_sum({name: term for name, term in terms.items() if name != "heatmap"}, config.loss)
        if choice == "ranked":
            shares = best_shares(encoding.weights.detach(), acted)
        nothing = torch.zeros_like(target[:, 0])
        share = {name: shares.detach() if name == "heatmap" else shares for name in terms}
        terms = {name: nothing.index_add(0, step, share[name] * term) for name, term in terms.items()}
        attention = self.net.view_attention
        if isinstance(attention, ViewAttention):
            terms["mutual_information"] = attention.redundancy(encoding.maps, encoding.weights)
        if choice in ("sampled", "ranked"):
            terms["choice"] = self._choice_loss(encoding, text, view, acted)
        if self.training and self.net.semantics.text_is_trained and self._meanings:
            terms["paraphrase"] = nothing + self._paraphrase_loss(nothing.device)
        per_step = losses.weighted_sum(terms, config.loss)

        log = {name: masked_mean(term, rows) for name, term in terms.items()}
        error = (predicted.position - target[step, :3]).norm(dim=-1)
        log["position_mm"] = 1e3 * masked_mean(error, rows[step] * shares)
        log |= {f"view_{name}": w for name, w in zip(config.cameras, encoding.weights.mean(dim=0), strict=True)}
        owner = window.real.nonzero()[lookback.decided, 0]
        each = torch.zeros(len(window.real), device=per_step.device).index_add(0, owner, per_step * rows)
        numbers = torch.stack(list(log.values())).tolist()  # at once: a device is waited for once
        return each if reduction == "none" else each.mean(), dict(zip(log, numbers, strict=True))

    @torch.no_grad()
    def select_action(self, batch: Batch, **_: Any) -> Float[Tensor, "b 8"]:
        """Next target of each environment: position [m], quaternion wxyz, gripper 1 open or 0 closed.

        With ``config.control.rate`` 0 that is the next key pose. Otherwise it is the next tick's target on the way
        there; an environment decides anew, and remembers what it sees, only when its macro step is over.

        Raises:
            ValueError: an input or the action is not finite, the number of environments changed without ``reset``, or
                the observation is that of a robot and ``config.control.rate`` is 0.
        """
        states = batch[keys.STATE]
        if self._past is None:
            self._past = Past(len(states), self.config.network.history.memory + 1)
        if len(self._past) != len(states):
            raise ValueError(f"{len(states)} environments, but the memory holds {len(self._past)}: call reset() first")
        if not self.config.control.rate:
            if keys.FROM_ROBOT in batch:
                raise ValueError(
                    "a robot's loop asks for an action, but policy.control.rate is 0: each call would answer with the "
                    "end of a macro step, however far away. Give --policy.control.rate=20 and the loop's rate, --fps=20"
                )
            return self._decide(batch, self._past, range(len(states)))
        return self._hold(batch, self._past)

    def _hold(self, batch: Batch, past: Past) -> Float[Tensor, "b 8"]:
        """The next tick's output of each environment; those whose macro step is over decide first."""
        states = batch[keys.STATE][:, : len(keys.POSE_NAMES)].double().cpu().numpy()
        if not self._held:
            low, high = (corner.double().cpu().numpy() for corner in self._box())
            self._held = [HeldStep(self.config.control, low, high, state) for state in states]
        outputs = np.zeros(states.shape, np.float32)
        due = []
        for row, state in enumerate(states):
            output = self._held[row].output(state)
            if output is None:
                due.append(row)
            else:
                outputs[row] = output
        if due:
            rows = torch.tensor(due, device=batch[keys.STATE].device)
            seen = {key: value[rows] for key, value in batch.items() if key.startswith(keys.OBS_PREFIX)}
            decided = self._decide(seen | {"task": [batch["task"][row] for row in due]}, past, due)
            for row, decision in zip(due, decided.double().cpu().numpy(), strict=True):
                outputs[row] = self._held[row].begin(decision, states[row])
        return torch.from_numpy(outputs).to(batch[keys.STATE].device)

    def _decide(self, batch: Batch, past: Past, rows: Sequence[int]) -> Float[Tensor, "n 8"]:
        """Key poses of the environments ``rows``, whose observations alone are in the batch."""
        window = read_window(batch, self.config.cameras)
        text = self._hear(batch["task"], window.tool.device)
        tool, heat = past.add_tools(rows, window.tool[:, -1])
        encoding = self.net.encode(replace(window, tool=tool, heat=heat).observe(text))
        fused, real = past.add_maps(rows, encoding.fused)
        count = real.sum(dim=1)
        enriched = self.net.remember(fused, text.repeat_interleave(count, dim=0), Lookback.over(real).newest())
        predicted, views = self.net.decode_best(encoding, enriched)
        decision = Decision.of(encoding, predicted, views[:, 1])
        self.last_decision = self.last_decision.updated(rows, decision) if self.last_decision else decision
        return self._action(predicted.position, predicted.quaternion, predicted.gripper)

    def predict_action_chunk(self, batch: Batch, **kwargs: Any) -> Float[Tensor, "b 1 8"]:
        """A chunk of one key pose."""
        return rearrange(self.select_action(batch, **kwargs), "b a -> b 1 a")

    def _action(
        self, position: Float[Tensor, "b 3"], quaternion: Float[Tensor, "b 4"], gripper: Float[Tensor, " b"]
    ) -> Float[Tensor, "b 8"]:
        canonical = torch.where(quaternion[:, :1] < 0, -quaternion, quaternion)
        pose = torch.cat([torch.clamp(position, *self._box()), canonical], dim=-1)
        if not (pose.isfinite().all() and gripper.isfinite().all()):
            raise ValueError(
                f"the policy's action is not finite: {pose.tolist()}, gripper {gripper.tolist()}; "
                "check the observation for NaN"
            )
        return torch.cat([pose, (gripper > 0).to(pose.dtype)[:, None]], dim=-1)

    def _box(self) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
        """Lower and upper corner [m] of the box that no output leaves."""
        workspace, corners = self.net.workspace, self.config.control.box
        if not corners:
            return workspace.low, workspace.high
        return workspace.low.new_tensor(corners[:3]), workspace.high.new_tensor(corners[3:])

    def _choice_loss(
        self, encoding: Encoding, text: Float[Tensor, "n c"], view: Int[Tensor, " m"], losses: Float[Tensor, " m"]
    ) -> Float[Tensor, " n"]:
        """Teaches the view weights which view decodes best; from detached maps, so as not to bend the features."""
        weights = self.net.view_attention(encoding.maps.detach(), text.detach(), encoding.weights > 0)
        if len(losses) == len(weights):
            return choice_loss(weights, view, losses)
        return ranking_loss(weights, losses.view_as(weights))

    def _augment(self, window: Window) -> Window:
        config = self.config.augment
        motion, turn = augment.random_world_motion(len(window.real), config, self.net.workspace.centre)
        return window.moved(motion, turn).distorted(config)

    def _paraphrase(self, sentences: list[str]) -> list[str]:
        """A random paraphrase of each recorded instruction."""
        choices = [self.config.instructions.get(sentence, [sentence]) for sentence in sentences]
        return [options[int(torch.randint(len(options), ()))] for options in choices]

    def _paraphrase_loss(self, device: torch.device) -> Float[Tensor, ""]:
        """Two wordings of each of a few random instructions, told apart by meaning."""
        picked = torch.randperm(len(self._meanings))[:MEANINGS].tolist()
        pairs = [torch.randperm(len(self._meanings[i]))[:2].tolist() for i in picked]
        sentences = [self._meanings[i][j] for i, pair in zip(picked, pairs, strict=True) for j in pair]
        owners = torch.tensor([i for i, pair in zip(picked, pairs, strict=True) for _ in pair], device=device)
        return losses.paraphrase_loss(self.net.semantics.text(sentences, device), owners)

    def _hear(self, sentences: list[str], device: torch.device) -> Float[Tensor, "n c"]:
        """Instruction vectors, encoded once until ``reset`` also by a trained tower.

        One that training never saw is encoded like any other, with one warning.
        """
        known = {sentence for options in self.config.instructions.values() for sentence in options}
        for sentence in set(sentences) - known - self._warned:
            logging.warning("instruction %r was not in the training data; the action relies on similar ones", sentence)
            self._warned.add(sentence)
        if fresh := [sentence for sentence in sentences if sentence not in self._heard]:
            self._heard.update(zip(fresh, self.net.semantics.text(fresh, device), strict=True))
        return torch.stack([self._heard[sentence] for sentence in sentences])
