"""Trial of the capture of a CUDA graph in a child process, for versions of PyTorch that a failed capture breaks."""

from __future__ import annotations

import io
import subprocess
import sys
from dataclasses import dataclass

import torch

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork, use_whole_float32
from sgsst_core.loss.graphs import FIRST_VISITS, LossGraphs
from sgsst_core.loss.sos import make_loss
from sgsst_core.parallel.division import Size
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import StylizationJob

#: Seconds after which the child process is killed.
_PATIENCE = 120.0


@dataclass(frozen=True)
class CaptureTrial:
    """Loss of random images with the network and the sizes of a job.

    Attributes:
        memory: Budget for activations in bytes.
        size: (height, width) of the views.
    """

    weights: BackboneWeights
    layers: tuple[str, ...]
    dtype: torch.dtype
    tf32: bool
    device: torch.device
    settings: Settings
    content_weight: float
    memory: int
    size: Size
    weighted: bool

    @staticmethod
    def of(job: StylizationJob, size: Size) -> CaptureTrial:
        """Return the trial of a job for views of a size."""
        network, loss = job.network, job.loss
        return CaptureTrial(
            job.weights, network.layers, network.dtype, network.tf32, network.device, job.settings,
            loss.content_weight, loss.memory, size, job.plan.weighted,
        )  # fmt: skip

    def run_in_child(self) -> str | None:
        """Return the reason why capturing fails in a child process; None if it works."""
        sent = io.BytesIO()
        torch.save(self, sent)
        command = [sys.executable, "-P", "-m", __name__]
        try:
            child = subprocess.run(command, input=sent.getvalue(), capture_output=True, check=False, timeout=_PATIENCE)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"a trial in a child process failed: {error}"
        if child.returncode == 0:
            return None
        last = (child.stderr.decode(errors="replace").strip().splitlines() or ["no message"])[-1]
        return f"a trial in a child process ended with status {child.returncode}: {last}"

    def run(self) -> None:
        """Evaluate until a graph is captured, and replay it.

        Raises:
            RuntimeError: If capturing fails.
        """
        use_whole_float32()
        network = FeatureNetwork(self.weights, self.layers, self.dtype, self.device, tf32=self.tf32)
        loss = make_loss(network, self.settings, self.memory, content_weight=self.content_weight)
        image = torch.rand((*self.size, 3), device=self.device)
        style, graphs = loss.targets.of_style(Style.of(image.cpu()), self.size), LossGraphs(loss)
        view = loss.targets.of_view(image, image[:, :, 0].contiguous() if self.weighted else None)
        for _ in range(FIRST_VISITS + 1):
            result = graphs.evaluate(image, style, view, loss.tiling.scales(self.size))
            if graphs.problem is not None:
                raise RuntimeError(graphs.problem)
        result.values.cpu()


if __name__ == "__main__":
    torch.load(io.BytesIO(sys.stdin.buffer.read()), weights_only=False).run()  # from the parent process
