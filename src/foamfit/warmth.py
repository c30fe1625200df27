"""Whether the compiled kernels are in their cache already."""

from __future__ import annotations

from pathlib import Path


def compiled() -> bool:
    """Tell whether an earlier run left the compiled integrator in the cache."""
    from foamfit.taylor import integrate

    return any(Path(integrate.stats.cache_path or ".").glob("taylor.integrate-*.nbc"))
