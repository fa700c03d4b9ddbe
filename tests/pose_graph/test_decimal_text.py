"""Numbers are parsed to the very doubles that Python's own parser gives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.arrays import FloatArray
from posegraph_slam.pose_graph.decimal_text import parse_lines, powers_of_five


def parse_reals(words: list[str]) -> FloatArray | None:
    """Parse single words, each a record of one real; None if one is left to the slow path."""
    data = np.frombuffer("".join(f"X {word}\n" for word in words).encode(), np.uint8)
    upper5, lower5 = powers_of_five()
    zero, n = np.zeros(1, np.int64), len(words)
    reals = np.zeros(n, np.uint64)
    done = parse_lines(data, np.frombuffer(b"X", np.uint8), np.array([0, 1]), np.array([0]), np.array([1]), zero, zero,
                       zero, upper5, lower5, np.zeros(0, np.int64), reals, np.zeros(n, np.int64))  # fmt: skip
    return reals.view(np.float64) if done else None


@given(st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False))
def test_shortest_decimals_read_back(value: float) -> None:
    parsed = parse_reals([repr(value)])
    assert parsed is not None
    assert np.array_equal(parsed.view(np.uint64), np.array([value]).view(np.uint64))


@given(st.integers(0, 10**25), st.integers(-330, 300))
def test_any_digits_are_rounded_rightly_or_left_alone(digits: int, exponent: int) -> None:
    word = f"{digits}e{exponent}"
    parsed = parse_reals([word])
    assert parsed is None or parsed[0] == float(word)


@pytest.mark.parametrize("form", ["{:.17g}", "{:.6f}", "{:.3e}", "{:.25e}", "{:+.9f}"])
def test_many_numbers_of_every_form(form: str) -> None:
    rng = np.random.default_rng(0)
    words = [form.format(value) for value in (rng.normal(size=5000) * 10.0 ** rng.integers(-8, 8, 5000)).tolist()]
    parsed = parse_reals(words)
    assert parsed is not None
    np.testing.assert_array_equal(parsed, [float(word) for word in words])


def test_halfway_cases_round_to_even() -> None:
    words = [
        "9007199254740993",
        "4503599627370496.5",
        "4503599627370497.5",
        "1e22",
        "8.5",
        "-0.0",
        "+.5",
        "1.",
        "00.10",
    ]
    parsed = parse_reals(words)
    assert parsed is not None
    np.testing.assert_array_equal(parsed, [float(word) for word in words])
    assert np.signbit(parsed[5])


@pytest.mark.parametrize(
    "word", ["nan", "inf", "1e400", "5e-324", "abc", "1_0", "1.2.3", "--1", "1e", "0x10", "1,5", "."]
)
def test_what_is_odd_is_left_to_the_slow_path(word: str) -> None:
    assert parse_reals([word]) is None
