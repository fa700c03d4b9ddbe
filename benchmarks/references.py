"""Figures of other systems on the public laser logs, for the tables of `slam2d.py`; nothing here is measured by it."""

from __future__ import annotations

from dataclasses import dataclass

KUEMMERLE = "Kümmerle et al. 2009"
CARTOGRAPHER = "Hess et al. 2016"
PUBLISHED = "published"
MEASURED = "measured with the same metric; configuration chosen per log, best of a few"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """Mean and standard deviation over all relations of a log, metres and degrees, CPU seconds; None: not told."""

    log: str
    system: str
    source: str
    metres: float
    metres_std: float | None = None
    degrees: float | None = None
    degrees_std: float | None = None
    cpu_s: float | None = None


REFERENCES = (
    Reference(log="intel", system="scan matching", source=KUEMMERLE, metres=0.220, metres_std=0.296),
    Reference(log="intel", system="RBPF (GMapping)", source=KUEMMERLE, metres=0.070, metres_std=0.083),
    Reference(log="intel", system="graph mapping", source=KUEMMERLE, metres=0.031, metres_std=0.026, degrees=1.3,
              degrees_std=4.7),
    Reference(log="intel", system="Cartographer", source=CARTOGRAPHER, metres=0.0229, metres_std=0.0239,
              degrees=0.453, degrees_std=1.335),
    Reference(log="intel", system="FLIRT", source=PUBLISHED, metres=0.02, metres_std=0.02, degrees=0.3,
              degrees_std=0.3),
    Reference(log="intel", system="Cartographer", source=MEASURED, metres=0.0371, metres_std=0.0471, degrees=0.348,
              cpu_s=185),
    Reference(log="intel", system="Cartographer, stock settings", source="measured with the same metric",
              metres=0.065, degrees=0.74),
    Reference(log="intel", system="GMapping, 30 particles", source=MEASURED, metres=0.0258, metres_std=0.0185,
              degrees=0.697, cpu_s=165),
    Reference(log="intel", system="Karto", source=MEASURED, metres=0.352, metres_std=1.149, degrees=0.831, cpu_s=36),
    Reference(log="intel", system="MRPT icp-slam", source=MEASURED, metres=1.88, degrees=10.6, cpu_s=69),
    Reference(log="fr079", system="scan matching", source=KUEMMERLE, metres=0.258, metres_std=0.427),
    Reference(log="fr079", system="RBPF (GMapping)", source=KUEMMERLE, metres=0.061, metres_std=0.044),
    Reference(log="fr079", system="graph mapping", source=KUEMMERLE, metres=0.056, metres_std=0.042, degrees=0.6,
              degrees_std=0.6),
    Reference(log="fr079", system="Cartographer", source=CARTOGRAPHER, metres=0.0452, metres_std=0.0354,
              degrees=0.538, degrees_std=0.718),
    Reference(log="fr079", system="FLIRT", source=PUBLISHED, metres=0.06, metres_std=0.09),
    Reference(log="fr079", system="Cartographer", source=MEASURED, metres=0.0435, metres_std=0.0579, degrees=0.504,
              cpu_s=247),
    Reference(log="fr079", system="GMapping, 30 particles", source=MEASURED, metres=3.11, degrees=10.1),
    Reference(log="fr079", system="Karto", source=MEASURED, metres=2.83, degrees=5.55),
    Reference(log="fr079", system="MRPT icp-slam", source=MEASURED, metres=0.0456, metres_std=0.0451, degrees=1.095,
              cpu_s=53),
)  # fmt: skip
