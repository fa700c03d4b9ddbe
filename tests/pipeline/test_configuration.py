"""Layers, errors, TOML output and the hash of the configuration, on a model of their own and on the real one."""

from __future__ import annotations

import tomllib
from enum import StrEnum
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, model_validator

from posegraph_slam.errors import ConfigurationError
from posegraph_slam.pipeline.configuration import (
    Configuration,
    available_presets,
    configuration_hash,
    find_configuration,
    load_configuration,
    preset_title,
    usable_workers,
)
from posegraph_slam.pipeline.settings_files import (
    Layer,
    allowed,
    build_settings,
    parse_override,
    read_layer,
    to_toml,
    walk_fields,
)
from posegraph_slam.settings import Settings


class Loss(StrEnum):
    HUBER = "huber"
    CAUCHY = "cauchy"


class Inner(Settings):
    """Deep keys."""

    depth: int = Field(3, ge=1, le=9)
    """How deep."""


class Section(Settings):
    """A section."""

    resolution_m: float = Field(0.05, gt=0)
    """Side of a cell."""
    enabled: bool = True
    """Whether it runs."""
    loss: Loss = Loss.HUBER
    """Robust loss."""
    mode: Literal["a", "b"] = "a"
    """Way of working."""
    size_m: float | None = Field(None, gt=0)
    """Fixed size."""
    offset: tuple[float, float] = (0.0, 1.5)
    """Where."""
    name: str = "x"
    """What it is called."""
    low: int = 0
    """Lower end."""
    high: int = 10
    """Upper end."""
    inner: Inner = Inner()

    @model_validator(mode="after")
    def _ordered(self) -> Section:
        if self.low > self.high:
            raise ValueError("low must not exceed high")
        return self


class Root(Settings):
    """All of it."""

    seed: int = Field(0, ge=0)
    """The seed."""
    mapping: Section = Section()
    coarse: Section = Section(resolution_m=0.5, name="coarse")
    """The same, coarser."""


def build(*overrides: str) -> Root:
    return build_settings(Root, [parse_override(text) for text in overrides])


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        ("mapping.resolution_m=1e-1", "resolution_m", 0.1),
        ("mapping.resolution_m = 2", "resolution_m", 2.0),
        ("mapping.enabled=false", "enabled", False),
        ("mapping.loss=cauchy", "loss", Loss.CAUCHY),
        ('mapping.mode="b"', "mode", "b"),
        ("mapping.size_m=40", "size_m", 40.0),
        ("mapping.size_m=none", "size_m", None),
        ("mapping.offset=[1, 2]", "offset", (1.0, 2.0)),
        ("mapping.name=two words = three", "name", "two words = three"),
    ],
)
def test_overrides_are_toml_values_and_else_strings(text: str, path: str, value: object) -> None:
    assert getattr(build(text).mapping, path) == value


def test_later_layers_win_key_by_key(tmp_path: Path) -> None:
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text("seed = 4\n[mapping]\nresolution_m = 0.1\nname = 'first'\n[mapping.inner]\ndepth = 5\n")
    second.write_text("mapping.name = 'second'\n")
    root = build_settings(Root, [read_layer(first), read_layer(second), parse_override("seed=7")])
    assert (root.seed, root.mapping.resolution_m, root.mapping.name, root.mapping.inner.depth) == (7, 0.1, "second", 5)


def test_one_key_of_a_section_leaves_its_other_defaults() -> None:
    root = build("coarse.low=1")
    assert (root.coarse.low, root.coarse.resolution_m, root.coarse.name) == (1, 0.5, "coarse")


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("mapping.resolutoin_m=1", "unknown key 'mapping.resolutoin_m'; did you mean 'mapping.resolution_m'?"),
        ("maping.resolution_m=1", "unknown key 'maping'; did you mean 'mapping'?"),
        ("resolution_m=1", "unknown key 'resolution_m'; did you mean 'mapping.resolution_m'?"),
        ("mapping.inner.depht=1", "did you mean 'mapping.inner.depth'?"),
        ("qqqq=1", "unknown key 'qqqq'; `psg config show` lists every key"),
        ("mapping.resolution_m=0", "'mapping.resolution_m' = 0 is not allowed; it must be a number > 0"),
        ("mapping.resolution_m=fine", "'mapping.resolution_m' = \"fine\" is not allowed; it must be a number > 0"),
        ("mapping.resolution_m=nan", "it must be a number > 0"),
        ("mapping.inner.depth=10", "it must be an integer >= 1 and <= 9"),
        ("mapping.inner.depth=2.5", "it must be an integer >= 1 and <= 9"),
        ("mapping.inner.depth=true", "it must be an integer >= 1 and <= 9"),
        ("mapping.enabled=1", "it must be true or false"),
        ("mapping.loss=l2", 'it must be one of "huber", "cauchy"'),
        ("mapping.mode=c", 'it must be one of "a", "b"'),
        ("mapping.size_m=-1", 'it must be a number > 0, or "none"'),
        ("mapping.offset=[1]", "'mapping.offset'"),
        ("mapping.name=3", "it must be a string"),
        ("mapping=3", "'mapping' is a section, not a value; its keys are mapping.resolution_m"),
        ("mapping.low=11", "mapping: low must not exceed high"),
        ("mapping", "--set mapping: is not of the form section.key=value"),
        ("=3", "is not of the form section.key=value"),
    ],
)
def test_errors_name_the_key_and_what_is_allowed(override: str, expected: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        build(override)
    assert expected in str(caught.value)
    assert str(caught.value).startswith("--set")
    assert "\n" not in str(caught.value)


def test_errors_name_the_file_that_the_value_came_from(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("[mapping]\nresolution_m = -1\n")
    with pytest.raises(ConfigurationError, match=r"mine\.toml: 'mapping\.resolution_m' = -1"):
        build_settings(Root, [read_layer(path), parse_override("seed=3")])
    path.write_text("seed = \n")
    with pytest.raises(ConfigurationError, match=r"mine\.toml: is not valid TOML.*line 1"):
        read_layer(path)
    path.write_bytes(b"seed = '\xff'\n")
    with pytest.raises(ConfigurationError, match="not valid TOML"):
        read_layer(path)
    for text in ("seed = " + "9" * 5000, "seed = " + "[" * 100_000):
        path.write_text(text)
        with pytest.raises(ConfigurationError, match=r"mine\.toml: is not valid TOML"):
            read_layer(path)
    with pytest.raises(ConfigurationError, match=r"absent\.toml: cannot be read \(No such file"):
        read_layer(tmp_path / "absent.toml")


def test_several_problems_are_counted() -> None:
    with pytest.raises(ConfigurationError, match=r"\(and 1 more\)"):
        build("mapping.resolution_m=0", "mapping.enabled=2")


@given(
    resolution=st.floats(min_value=1e-12, max_value=1e12),
    depth=st.integers(1, 9),
    name=st.text(st.characters(exclude_categories=["Cs"])),
    size=st.none() | st.floats(min_value=1e-3, max_value=1e3),
    offset=st.tuples(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9)),
    loss=st.sampled_from(Loss),
)
def test_toml_reads_back_as_the_same_settings(resolution, depth, name, size, offset, loss) -> None:
    section = Section(
        resolution_m=resolution, inner=Inner(depth=depth), name=name, size_m=size, offset=offset, loss=loss
    )
    root = Root(seed=depth, coarse=section)
    values = tomllib.loads(to_toml(root))
    again = build_settings(Root, [Layer(source="file", values=values)])
    assert again == root


def test_toml_describes_each_key() -> None:
    text = to_toml(Root())
    assert "# Side of a cell. [a number > 0]\nresolution_m = 0.05\n" in text
    assert "# The same, coarser.\n[coarse]\n" in text
    assert "# A section.\n[mapping]\n" in text
    assert "# Deep keys.\n[mapping.inner]\n# How deep. [an integer >= 1 and <= 9]\ndepth = 3\n" in text


def test_every_key_of_the_configuration_is_described_and_bounded() -> None:
    for name, info, _ in walk_fields(Configuration):
        assert info.description, f"{name} has no description"
        assert "\n#" not in allowed(info)
        if info.annotation in (int, float):
            assert info.metadata, f"{name} has no range"


def test_default_preset_is_what_the_models_say() -> None:
    written = find_configuration("default").read_text(encoding="utf-8")
    generated = to_toml(Configuration())
    assert written == generated, "renew it: make presets"


@pytest.mark.parametrize("name", sorted(available_presets()))
def test_every_preset_loads_and_says_what_it_is_for(name: str) -> None:
    load_configuration([name])
    assert len(preset_title(find_configuration(name))) > 10


def test_presets_by_name_and_files_by_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("seed = 5\n")
    assert load_configuration([path]).seed == 5
    assert load_configuration([path], seed=6).seed == 6
    assert load_configuration(["default", path], ["seed=8"]).seed == 8
    with pytest.raises(ConfigurationError, match=r"neither a file nor a preset; the presets are .*default"):
        load_configuration(["no_such_preset"])
    with pytest.raises(ConfigurationError, match="--seed: 'seed' = -1 is not allowed"):
        load_configuration(seed=-1)


def test_hash_follows_results_not_workers() -> None:
    base = configuration_hash(Configuration())
    assert len(base) == 64
    assert configuration_hash(Configuration(workers=3)) == base
    assert configuration_hash(Configuration(seed=1)) != base


def test_workers_default_to_the_cores() -> None:
    assert usable_workers(Configuration()) >= 1
    assert usable_workers(Configuration(workers=3)) == 3
