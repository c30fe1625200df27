"""foamfit: identify the parameters of hysteretic bistable springs from impact tests on foams.

`__init__.pyi` lists the names; each is imported when it is first used, so that the command starts
quickly.
"""

import lazy_loader

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("foamfit")
    return _attribute(name)
