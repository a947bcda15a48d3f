"""The HistMV policy: windows, loss and the memory of past steps around ``HistMVNet``."""

import logging
from collections import deque
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from einops import rearrange, repeat
from huggingface_hub import ModelCard
from jaxtyping import Float, Int
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from lerobot_histmv import keys
from lerobot_histmv.chance import drawn_from
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.data.instructions import load_paraphrases, meanings
from lerobot_histmv.model import augment, losses
from lerobot_histmv.model.layers import full_precision, masked_mean
from lerobot_histmv.model.network import Encoding, HistMVNet
from lerobot_histmv.model.view_attention import best_shares, choice_loss, ranking_loss
from lerobot_histmv.model_card import model_card
from lerobot_histmv.windows import Window, causal_heat, read_window, row_weights

Batch = dict[str, Any]
MEANINGS = 12
"""Instructions that one training step tells apart."""


@dataclass
class Decision:
    """What the last decision of a batch of environments looked like, for pictures.

    Args:
        weights: view weights.
        view: index of the chosen view.
        heat: heat map over the chosen view's pixels, sums to 1.
        surface: expectation of the heat map over the cloud, before the offset [m].
    """

    weights: Float[Tensor, "b k"]
    view: Int[Tensor, " b"]
    heat: Float[Tensor, "b y x"]
    surface: Float[Tensor, "b 3"]


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
            raise ValueError(f"checkpoint {model_file} was made with another configuration: {error}") from error

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
        """All trainable parameters."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def reset(self) -> None:
        """Forget all past steps; call it whenever the environments are reset."""
        steps = self.config.network.history.past_steps + 1
        self._fused: deque[Float[Tensor, "b d h w"]] = deque(maxlen=steps)
        self._tools: deque[Float[Tensor, "b 3"]] = deque(maxlen=steps)
        self.last_decision: Decision | None = None

    def forward(self, batch: Batch, reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Loss over every real step of the windows, each row of the dataset counting once.

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
        choice = config.network.views.train_choice if self.training else "best"
        encoding, predicted, views, shares = self.net(seen, window.real, choice)

        step, view = views.unbind(-1)
        target = window.target
        terms = losses.action_losses(predicted, target[step], encoding.cloud[step, view], config.loss)
        # Views are judged by their actions alone: one that shows nothing near the target has no heat map loss at all.
        acted = losses.weighted_sum({name: term for name, term in terms.items() if name != "heatmap"}, config.loss)
        if choice == "ranked":
            shares = best_shares(encoding.weights.detach(), acted)
        nothing = torch.zeros_like(seen.heat[:, 0])
        share = {name: shares.detach() if name == "heatmap" else shares for name in terms}
        terms = {name: nothing.index_add(0, step, share[name] * term) for name, term in terms.items()}
        terms["mutual_information"] = self.net.view_attention.redundancy(encoding.maps, encoding.weights)
        if choice in ("sampled", "ranked"):
            terms["choice"] = self._choice_loss(encoding, seen.text, view, acted)
        if self.training and self.net.semantics.text_is_trained and self._meanings:
            terms["paraphrase"] = nothing + self._paraphrase_loss(nothing.device)
        per_step = losses.weighted_sum(terms, config.loss)

        rows = row_weights(window.real, config.network.history.past_steps)
        log = {name: masked_mean(term, rows).item() for name, term in terms.items()}
        error = (predicted.position - target[step, :3]).norm(dim=-1)
        log["position_mm"] = 1e3 * masked_mean(error.detach(), rows[step] * shares.detach()).item()
        log |= {f"view_{name}": w.item() for name, w in zip(config.cameras, encoding.weights.mean(dim=0), strict=True)}
        if reduction == "none":
            owner = window.real.nonzero()[:, 0]
            return torch.zeros(len(window.real), device=per_step.device).index_add(0, owner, per_step * rows), log
        return masked_mean(per_step, rows), log

    @torch.no_grad()
    def select_action(self, batch: Batch, **_: Any) -> Float[Tensor, "b 8"]:
        """Next key pose of each environment: position [m], quaternion wxyz, gripper 1 open or 0 closed."""
        if self._fused and len(self._fused[0]) != len(batch[keys.STATE]):
            raise ValueError(
                f"{len(batch[keys.STATE])} environments, but the memory holds {len(self._fused[0])}: call reset() first"
            )
        window = read_window(batch, self.config.cameras)
        self._tools.append(window.tool)
        age = torch.arange(len(self._tools) - 1, -1, -1, device=window.tool.device)
        heat = repeat(causal_heat(age), "p -> b p", b=len(window.tool))
        text = self.net.semantics.text(self._known(batch["task"]), window.tool.device)
        seen = window.observe(text, torch.stack(list(self._tools), dim=1), heat)
        encoding = self.net.encode(seen)
        self._fused.append(encoding.fused)
        real = torch.ones(len(window.tool), len(self._fused), dtype=torch.bool, device=window.tool.device)
        fused = rearrange(torch.stack(list(self._fused), dim=1), "b t d h w -> (b t) d h w")
        enriched = self.net.remember(fused, text.repeat_interleave(len(self._fused), dim=0), real)
        predicted, views = self.net.decode_best(encoding, enriched[len(self._fused) - 1 :: len(self._fused)])
        self.last_decision = Decision(encoding.weights, views[:, 1], predicted.log_heat.exp(), predicted.surface)
        return self._action(predicted.position, predicted.quaternion, predicted.gripper)

    def predict_action_chunk(self, batch: Batch, **kwargs: Any) -> Float[Tensor, "b 1 8"]:
        """A chunk of one key pose."""
        return rearrange(self.select_action(batch, **kwargs), "b a -> b 1 a")

    def _action(
        self, position: Float[Tensor, "b 3"], quaternion: Float[Tensor, "b 4"], gripper: Float[Tensor, " b"]
    ) -> Float[Tensor, "b 8"]:
        workspace = self.net.workspace
        position = torch.minimum(torch.maximum(position, workspace.low), workspace.high)
        canonical = torch.where(quaternion[:, :1] < 0, -quaternion, quaternion)
        action = torch.cat([position, canonical, (gripper > 0).to(position.dtype)[:, None]], dim=-1)
        if not action.isfinite().all():
            raise ValueError(f"the policy's action is not finite: {action.tolist()}; check the observation for NaN")
        return action

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

    def _known(self, sentences: list[str]) -> list[str]:
        """The sentences, with one warning for each that training never saw: it is encoded like any other."""
        known = {sentence for options in self.config.instructions.values() for sentence in options}
        for sentence in set(sentences) - known - self._warned:
            logging.warning("instruction %r was not in the training data; the action relies on similar ones", sentence)
            self._warned.add(sentence)
        return sentences
