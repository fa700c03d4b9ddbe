"""Workers for the tests of maps that are built in pieces."""

from __future__ import annotations

import pickle

import pytest


class TwoAtATime:
    """Two workers behind a wall: what goes there and comes back is pickled, and the last piece is done first."""

    workers = 2

    def map(self, function, items):
        sent = [pickle.dumps((function, item)) for item in items]
        results = [pickle.dumps(call(item)) for call, item in map(pickle.loads, reversed(sent))]
        return [pickle.loads(result) for result in reversed(results)]


@pytest.fixture
def two_at_a_time() -> TwoAtATime:
    return TwoAtATime()
