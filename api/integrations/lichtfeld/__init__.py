"""Plugin of LichtFeld Studio that paints the splats of the open scene on a service of sgsst."""

import lichtfeld as lf

from .panel import SgsstPanel


def on_load() -> None:
    """Add the panel."""
    lf.register_class(SgsstPanel)


def on_unload() -> None:
    """Cancel a running job, and remove the panel."""
    if SgsstPanel.running is not None:
        SgsstPanel.running.job.canceled.set()
    lf.unregister_class(SgsstPanel)
