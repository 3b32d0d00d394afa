"""The compiled core: arrays in, arrays out, without the interpreter's lock.

Its functions are described in the headers beside this file, their arguments in `bindings.cpp`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """A function of the core, or a constant."""


try:
    from hmt_ros.core._compiled import *  # noqa: F403
except ModuleNotFoundError as error:
    raise ImportError(
        'the compiled core of hmt_ros is missing: "make core" builds it in a clone, "colcon build" '
        'or "pip install ." with the package'
    ) from error
