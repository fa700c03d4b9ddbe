"""Print the exact versions of everything that this package and its development tools need, as pip constraints."""

from __future__ import annotations

import re
from importlib.metadata import distribution

from packaging.requirements import Requirement

PACKAGE = "posegraph_slam"


def canonical(name: str) -> str:
    """Return the normalised name of a distribution."""
    return re.sub(r"[-_.]+", "-", name).lower()


def closure(name: str, extras: frozenset[str], found: dict[str, str], seen: set[tuple[str, frozenset[str]]]) -> None:
    """Add to `found` the version of every installed distribution that `name` with `extras` leads to."""
    if (canonical(name), extras) in seen:
        return
    seen.add((canonical(name), extras))
    installed = distribution(name)
    found[canonical(name)] = installed.version
    for line in installed.requires or []:
        requirement = Requirement(line)
        wanted = [{"extra": extra} for extra in extras] or [{"extra": ""}]
        if requirement.marker is None or any(requirement.marker.evaluate(environment) for environment in wanted):
            closure(requirement.name, frozenset(requirement.extras), found, seen)


def main() -> None:
    """Print the run-time closure first, then what only development adds."""
    runtime: dict[str, str] = {}
    closure(PACKAGE, frozenset(), runtime, set())
    everything: dict[str, str] = {}
    closure(PACKAGE, frozenset({"dev"}), everything, set())
    print("# Exact versions of what `make demo` and `make test` install; renewed by `make lock` from a tested .venv.")
    print("# Run time")
    print("\n".join(f"{name}=={runtime[name]}" for name in sorted(runtime) if name != canonical(PACKAGE)))
    print("# Development only")
    print("\n".join(f"{name}=={everything[name]}" for name in sorted(set(everything) - set(runtime))))


if __name__ == "__main__":
    main()
