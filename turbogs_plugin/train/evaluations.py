"""Evaluations during training: at its beginning, and where its pace asks for one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from turbogs_plugin.device import peak_memory_bytes
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.train.evaluate import Lpips, Metrics, evaluate
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop


@dataclass
class Evaluations(Listener):
    """Evaluates the model and passes the result to all listeners.

    Args:
        test: the test views, on the trainer's device.
        lpips: from `load_lpips`, for the evaluation at the end; None: no LPIPS.
        peak_memory: gives the bytes to record; None: the peak of the process so far.

    Attributes:
        history: every evaluation.
        metrics: those of the newest one.
    """

    test: PosedImages
    lpips: Lpips | None = None
    peak_memory: Callable[[], int] | None = None
    history: list[Evaluation] = field(default_factory=list, init=False)
    metrics: Metrics | None = field(default=None, init=False)

    def metrics_at(self, iteration: int) -> Metrics | None:
        """Those of the evaluation that this process made at an iteration, if it is the newest; None otherwise."""
        return self.metrics if self.history and self.history[-1].iteration == iteration else None

    def begun(self, loop: TrainingLoop) -> None:
        if not self.history:
            self.evaluation_due(loop)

    def evaluation_due(self, loop: TrainingLoop) -> None:
        for listener in loop.listeners:
            listener.evaluating(loop)
        trainer = loop.trainer
        trainer.require_finite()
        metrics = evaluate(
            trainer.gaussians,
            self.test,
            trainer.look(self.test.names),
            lpips=self.lpips if loop.finished else None,
            aligned=trainer.exposures is not None,
            refined=loop.finished,
        )
        mean = metrics.mean
        evaluation = Evaluation(
            iteration=trainer.iteration,
            train_seconds=loop.clock.seconds,
            psnr=mean.psnr,
            ssim=mean.ssim,
            l1=mean.l1,
            num_gaussians=len(trainer.gaussians),
            memory_bytes=self.peak_memory() if self.peak_memory else peak_memory_bytes(trainer.device),
            nonfinite_losses=int(trainer.nonfinite_losses),
            skipped_updates=int(trainer.optimizer.skipped),
            worst_psnr=metrics.worst_psnr,
            **mean.further(),
        )
        self.history.append(evaluation)
        self.metrics = metrics
        for listener in loop.listeners:
            listener.evaluated(loop, evaluation)
