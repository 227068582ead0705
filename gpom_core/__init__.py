"""The map as numbers: scans in, occupancy with its uncertainty out. No network, files or clock.

    mapper = Mapper()
    mapper.update(scan)
    prediction = mapper.train().query(points)

The method is that of Kim & Kim, "Efficient Clustering for Continuous Occupancy Mapping Using a
Mixture of Gaussian Processes", Sensors 2022. Its symbols and where they are here:

===================  ====================================================================
k(x, x')             `kernels.gram`, the squared exponential (eq. 6)
k_I                  `averages.line_averages`, point against segment (eq. 11)
l, s_f               `Hyperparameters.length_scale_m`, `.signal_std`
K, y                 `expert.train`: Gram matrix and targets, +1 hit, -1 free (eq. 8-10)
m_i, v_i             mean and variance of expert i
p_i, p_0             prior variance of expert i and of the committee
eta, Lambda          information and precision of the committee (eq. 13, corrected)
a, b                 `calibration.Calibration` of the paper's batch maps; online it is `link.Link`
Algorithm 1          `lines.track_lines`
===================  ====================================================================

What is heavy is imported when it is first used, so a robot that only sends scans starts fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gpom_core.errors import ConfigurationError, GpomError, InvalidQueryError, InvalidScanError
from gpom_core.scan import Pose2D, Scan

if TYPE_CHECKING:
    from gpom_core.config import MapConfig
    from gpom_core.evidence import UpdateReport
    from gpom_core.mapper import Mapper
    from gpom_core.snapshot import Prediction, Snapshot

__all__ = [
    "ConfigurationError",
    "GpomError",
    "InvalidQueryError",
    "InvalidScanError",
    "MapConfig",
    "Mapper",
    "Pose2D",
    "Prediction",
    "Scan",
    "Snapshot",
    "UpdateReport",
]

_LATER = {
    "MapConfig": "config",
    "Mapper": "mapper",
    "Prediction": "snapshot",
    "Snapshot": "snapshot",
    "UpdateReport": "evidence",
}


def __getattr__(name: str) -> Any:
    """Import what was not needed until now (PEP 562)."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
