"""Samples of a Markov chain as a netCDF 3 file and as an xarray dataset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.springs.parameters import unit_of

if TYPE_CHECKING:
    import xarray

FILE = "samples.nc"
_DIMS = ("chain", "draw")


def write_samples(path: Path, draws: Mapping[str, Array]) -> None:
    """Write samples (chain, draw) of parameters in SI; `xarray.open_dataset` reads the file."""
    from scipy.io import netcdf_file

    with netcdf_file(path, "w", version=2) as file:
        for dim, size in zip(_DIMS, next(iter(draws.values())).shape, strict=True):
            file.createDimension(dim, size)
            file.createVariable(dim, "i4", (dim,))[:] = np.arange(size)
        for name, values in draws.items():
            variable: Any = file.createVariable(name, "f8", _DIMS)
            variable[:] = values
            variable.units = unit_of(name) or "1"


def read_samples(path: Path) -> dict[str, Array]:
    """Read a file of `write_samples`; return an empty dict if the file does not exist."""
    from scipy.io import netcdf_file

    if not path.is_file():
        return {}
    try:
        with netcdf_file(path, "r", mmap=False) as file:
            found = file.variables.items()
            return {name: np.array(v[:], dtype=float) for name, v in found if name not in _DIMS}
    except (OSError, ValueError, TypeError, IndexError) as error:
        raise InputError(f"{path} is damaged: {error}") from None


def dataset(draws: Mapping[str, Array], **about: str) -> xarray.Dataset:
    """Return samples in the form that ArviZ reads: dimensions chain and draw, attributes `units`.

    Raises
    ------
    InputError
        If xarray is not installed.
    """
    try:
        import xarray
    except ImportError:
        raise InputError(
            'samples need xarray, which is not installed; pip install "foamfit[mcmc]"'
        ) from None
    columns = {n: (_DIMS, values, {"units": unit_of(n) or "1"}) for n, values in draws.items()}
    sizes = zip(_DIMS, next(iter(draws.values())).shape, strict=True)
    return xarray.Dataset(columns, {dim: np.arange(size) for dim, size in sizes}, about)
