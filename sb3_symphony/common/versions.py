"""What results depend on bit for bit, apart from settings: packages, and the processor's instructions."""

import platform
from importlib.metadata import version

from sb3_symphony import __version__

_PACKAGES = ("torch", "numpy", "numba", "stable_baselines3", "sb3_contrib", "gymnasium")


def package_versions() -> dict[str, str]:
    """:return: those of Python and the packages that results depend on"""
    return {
        "sb3_symphony": __version__,
        **{package: version(package) for package in _PACKAGES},
        "Python": platform.python_version(),
    }


def processor() -> str:
    """:return: its architecture, and the vector instructions that torch uses"""
    import torch as th

    return f"{platform.machine()} {th.backends.cpu.get_cpu_capability()}"
