"""What the integrator assumes about the networks of this package."""

from __future__ import annotations

from mapfusion.integrate.config import IntegratorConfig

NETWORK_ERRORS = IntegratorConfig(common_deviation=0.2)
"""A network with a memory repeats its error from frame to frame, so that its detections agree better with each other
than with the truth. The common part is chosen on the validation towns of the demo world and the ``lite`` weights."""
