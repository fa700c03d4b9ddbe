"""How far the streams of a log cover the same time."""

from __future__ import annotations

from collections.abc import Mapping

from posegraph_slam.arrays import FloatArray

TOLERANCE_S = 0.2
"""A start or end this much away from the reference stream is not worth a sentence; slow streams run at 5 Hz."""


def uneven_coverage(stamps_s: Mapping[str, FloatArray]) -> tuple[str, ...]:
    """Describe each stream that starts later or ends earlier than the first one, a sentence a stream.

    `stamps_s` maps the name of a stream to its stamps (N,); the first stream that is not empty is the reference.
    """
    streams = {name: stamps for name, stamps in stamps_s.items() if len(stamps)}
    if not streams:
        return ()
    reference, *others = streams
    first, last = float(streams[reference].min()), float(streams[reference].max())
    sentences = []
    for name in others:
        late, early = float(streams[name].min()) - first, last - float(streams[name].max())
        missing = [f"starts {late:.2f} s after"] * (late > TOLERANCE_S)
        missing += [f"ends {early:.2f} s before"] * (early > TOLERANCE_S)
        if missing:
            sentences.append(f"the {name} stream {' and '.join(missing)} the {reference} stream")
    return tuple(sentences)
