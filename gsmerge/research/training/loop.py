"""Train with AdamW on windows of photos, with validation and checkpoints; an interrupted run can be resumed.

Validation uses the same windows of its examples every time. The examples are read one after another.

Random numbers depend only on seed and step, and the gradients of crops are added in order, so that a resumed run ends
with the same bytes as an uninterrupted run, on any number of threads.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor
from torch.nn import Parameter

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass
from gsmerge.io.atomic import atomic_output
from gsmerge.method.geometry.views import even_views
from gsmerge.method.networks.corrections import LOGIT_COLUMN
from gsmerge.reading.checkpoint import save_checkpoint
from gsmerge.research.training.backbones import Capture, draw_example
from gsmerge.research.training.examples import Example, recolor
from gsmerge.research.training.losses import render_window, window_loss, window_psnr
from gsmerge.research.training.modules import Head, Networks
from gsmerge.research.training.shards import Shard, read_shard
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.research.training.windows import Window, sample_window
from gsmerge.runtime.threads import parallel_map, use_threads

VALIDATION = 2**32  # replaces the step in the seed of the random numbers of validation
LossRow = dict[str, float]  # a row of the table of losses, by column
OnTrainingStep = Callable[[int, int, float], None]  # called with step, number of steps, loss
RUN_FORMAT = "gsmerge-training"
RUN_REMEDY = "choose another --output, or remove it to start again"


def validate(networks: Networks, shards: Sequence[Shard | Capture], options: TrainOptions) -> LossRow:
    """Measure the mean PSNR (dB) of windows without and with networks, and the share of merged Feature Gaussians."""

    def score_window(window: Window) -> tuple[float, float, float]:
        """Return the PSNR (dB) without and with networks, and the share of merged Feature Gaussians."""
        plain, _ = render_window(window, None, options)
        image, matched = render_window(window, networks, options)
        return window_psnr(window, plain), window_psnr(window, image), matched

    scores = list[tuple[float, float, float]]()
    for number, shard in enumerate(shards):
        rng = np.random.default_rng([options.seed, VALIDATION, number])  # a shard gets the same windows every time
        read = lru_cache(1)(read_shard)
        windows = list[Window]()
        for _ in range(options.validation_windows):
            part = draw_example(shard, options, rng, read)
            windows.append(sample_window(part, options.levels, options.window, options.most, novel=1, rng=rng))
        scores += parallel_map(score_window, windows)
    analytic, learned, matched = np.mean(scores, 0).tolist()
    return {"psnr_analytic": analytic, "psnr_learned": learned, "matched": matched}


@dataclass(frozen=True, eq=False)
class TrainingState:
    """State of a training run: networks, running means of their weights, and moments of the optimiser."""

    networks: Networks
    smooth: Networks  # has the running means as weights
    optimizer: torch.optim.Optimizer

    def pairs(self) -> Iterator[tuple[str, Parameter, Parameter]]:
        """Yield the name, the value and the running mean of each parameter."""
        for (name, parameter), mean in zip(self.networks.named_parameters(), self.smooth.parameters(), strict=True):
            yield name, parameter, mean


@dataclass(frozen=True)
class TrainResult:
    """Files and figures of a training run."""

    best: Path  # checkpoint with the highest PSNR in validation
    last: Path  # checkpoint of the last step
    losses: Path  # CSV, one row for each validation
    step: int  # number of steps done
    loss: float  # last training loss
    psnr_analytic: float  # PSNR (dB) of the validation windows without networks
    psnr_learned: float  # best PSNR (dB) with networks
    resumed: int  # step from which the run was resumed; 0 for a new run


def train(
    shards: Sequence[Shard | Capture],
    validation: Sequence[Shard | Capture],
    out: Path,
    options: TrainOptions | None = None,
    *,
    threads: int | None = None,
    progress: OnTrainingStep = lambda *_: None,
) -> TrainResult:
    """Train networks, or continue the run in the folder.

    Args:
        shards: At least one example: stored ones, or captures whose Gaussians a frozen backbone predicts.
        validation: Examples by which the best checkpoint is chosen; empty: other windows of ``shards``.
        out: Folder for ``best.safetensors``, ``last.safetensors``, ``losses.csv`` and ``state.safetensors``.
        options: Settings.
        threads: Number of threads; None: all processors. The result does not depend on the number of threads.
        progress: Called with (step, steps, loss) after every step.

    Raises:
        ValueError: If there are no examples.
        GsmergeError: If LPIPS has a weight in the loss, and its network weights are not installed.
        SceneError: If a shard is damaged, or the folder has another run or cannot be written.
    """
    options = options or TrainOptions()
    if not shards:
        raise ValueError("examples: expected at least one, got none")
    options.require_weights()
    out.mkdir(parents=True, exist_ok=True)
    validators: Sequence[Shard | Capture] = validation or shards
    ids = even_views(len(validators), min(len(validators), options.validation_examples))
    validators = [validators[i] for i in ids]
    hashes = {kind: [shard.sha256 for shard in part] for kind, part in (("data", shards), ("validation", validators))}
    facts = {"options": options.to_dict(), **hashes}
    with use_threads(threads):
        with torch.random.fork_rng(devices=[]):  # new networks depend only on the seed
            torch.manual_seed(options.seed)
            networks = Networks(options.network)
        optimizer = torch.optim.AdamW(networks.parameters(), lr=options.rate, weight_decay=options.decay)
        state = TrainingState(networks, deepcopy(networks).requires_grad_(False), optimizer)
        step = 0
        rows = list[LossRow]()
        path = out / "state.safetensors"
        if path.exists():
            stored = load_training(path, state)
            for name, value in facts.items():
                if stored.get(name) != value:
                    raise SceneError(path, f"expected a run with the same {name}, found another", RUN_REMEDY)
            step = int(stored["step"])
            rows = list(stored["rows"])
        resumed = step
        losses = list[Tensor]()
        read = lru_cache(options.buffer)(read_shard)
        while step < options.steps:
            losses.append(_take_step(state, shards, read, options, step))
            step += 1
            progress(step, options.steps, float(losses[-1]))
            if step % options.save_every == 0 or step == options.steps:
                scores = validate(state.smooth, validators, options)
                mean = float(torch.stack(losses).mean())
                rows.append({"step": step, "rate": options.rate_at(step - 1), "loss": mean, **scores})
                losses = []
                _save_run(out, state, rows, facts, options)
    paths = (out / "best.safetensors", out / "last.safetensors", out / "losses.csv")
    best_psnr = max(row["psnr_learned"] for row in rows)
    return TrainResult(
        *paths, step=step, loss=rows[-1]["loss"], psnr_analytic=rows[-1]["psnr_analytic"], psnr_learned=best_psnr,
        resumed=resumed,
    )  # fmt: skip


def _save_run(
    out: Path, state: TrainingState, rows: Sequence[LossRow], facts: Mapping[str, Any], options: TrainOptions
) -> None:
    """Write the checkpoints, the table of losses, and the state for resuming the run.

    ``facts`` are options and hashes of the run, which all files but the table contain. The best checkpoint is replaced
    if the last row has the highest PSNR.
    """
    figures = {name: value for name, value in rows[-1].items() if name not in ("step", "rate", "loss")}
    training = {"step": rows[-1]["step"], "loss": rows[-1]["loss"], "figures": figures, **facts}
    networks = deepcopy(state.smooth)
    with torch.no_grad():  # checkpoints have the opacity shift in the bias of the heads
        for module in networks.heads.values():
            assert isinstance(module, Head)
            module.out.bias[LOGIT_COLUMN] += options.opacity_shift
    if all(row["psnr_learned"] < rows[-1]["psnr_learned"] for row in rows[:-1]):
        save_checkpoint(out / "best.safetensors", networks.weights(), training)
    save_checkpoint(out / "last.safetensors", networks.weights(), training)
    lines = [",".join(rows[0]), *(",".join(f"{value:.8g}" for value in row.values()) for row in rows)]
    with atomic_output(out / "losses.csv", overwrite=True) as temporary:
        temporary.write_bytes("\n".join([*lines, ""]).encode())
    # The state has weights, running means and moments, so that the run can be resumed
    tensors: dict[str, torch.Tensor] = {}
    for name, parameter, mean in state.pairs():
        moments = state.optimizer.state[parameter]
        named = {"weight": parameter, "mean": mean, "first": moments["exp_avg"], "second": moments["exp_avg_sq"]}
        tensors |= {f"{kind}.{name}": tensor.detach() for kind, tensor in named.items()}
    content = save(tensors, {RUN_FORMAT: json.dumps({"step": rows[-1]["step"], "rows": rows, **facts})})
    with atomic_output(out / "state.safetensors", overwrite=True) as temporary:
        temporary.write_bytes(content)


def _take_step(
    state: TrainingState,
    shards: Sequence[Shard | Capture],
    read: Callable[[Shard], Example],
    options: TrainOptions,
    step: int,
) -> Tensor:
    """Take one step on the mean gradient of all crops, each of a random example; return the mean loss."""
    parameters = list(state.networks.parameters())

    def crop_gradients(crop: int) -> Tensor:
        """Compute the gradients of one crop as one vector, whose last element is the loss."""
        rng = np.random.default_rng([options.seed, step, crop])
        example = draw_example(shards[int(rng.integers(len(shards)))], options, rng, read)
        if options.recolor:
            example = recolor(example, rng)
        window = sample_window(
            example, options.levels, side=options.window, most=options.most, novel=options.novel, rng=rng
        )
        with torch.enable_grad():
            loss = window_loss(state.networks, window, options, step, rng)
            gradients = [torch.zeros_like(parameter) for parameter in parameters]
            if loss.requires_grad:
                gradients = list(torch.autograd.grad(loss, parameters, materialize_grads=True))
        loss = loss.detach().to(gradients[0])  # LPIPS is float64
        return torch.cat([*(gradient.flatten() for gradient in gradients), loss[None]])

    mean = torch.stack(parallel_map(crop_gradients, range(options.crops))).sum(0) / options.crops
    sizes = [parameter.numel() for parameter in parameters]
    gradients, loss = mean.split([sum(sizes), 1])
    for parameter, gradient in zip(parameters, gradients.split(sizes), strict=True):
        parameter.grad = gradient.view_as(parameter)
    torch.nn.utils.clip_grad_norm_(parameters, options.clip)
    for group in state.optimizer.param_groups:
        group["lr"] = options.rate_at(step)
    state.optimizer.step()
    # The share is small at first, so that the mean forgets the first weights soon
    share = min(options.average, (1 + step) / (10 + step))
    with torch.no_grad():
        for _, parameter, smooth in state.pairs():
            smooth.lerp_(parameter, 1 - share)
    return loss[0]


def load_training(path: Path, state: TrainingState) -> dict[str, Any]:
    """Read the state that :func:`_save_run` wrote into ``state``; return the facts about the run.

    Raises SceneError if the file is damaged or has other networks.
    """
    try:
        with safe_open(path, "pt") as file:
            facts = json.loads((file.metadata() or {})[RUN_FORMAT])
            with torch.no_grad():
                for name, parameter, mean in state.pairs():
                    parameter.copy_(file.get_tensor(f"weight.{name}"))
                    mean.copy_(file.get_tensor(f"mean.{name}"))
                    first, second = (file.get_tensor(f"{kind}.{name}") for kind in ("first", "second"))
                    step = torch.tensor(float(facts["step"]))
                    state.optimizer.state[parameter] = {"step": step, "exp_avg": first, "exp_avg_sq": second}
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise SceneError(
            path, "expected the state of a training run, found a damaged file or another", RUN_REMEDY
        ) from error
    return dict(facts)
