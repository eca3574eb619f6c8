# The few names that kiteline uses of numba. A decorated kernel keeps the types of the Python function.
from collections.abc import Callable
from typing import Any, TypeVar, overload

F = TypeVar("F", bound=Callable[..., Any])

__version__: str
config: Any
types: Any
typed: Any

@overload
def njit(function: F, /) -> F: ...
@overload
def njit(
    signature: Any = ...,
    /,
    *,
    cache: bool = ...,
    nogil: bool = ...,
    inline: str = ...,
    forceinline: bool = ...,
    _nrt: bool = ...,
    boundscheck: bool = ...,
    error_model: str = ...,
    locals: dict[str, Any] = ...,
) -> Callable[[F], F]: ...
def get_num_threads() -> int: ...
def set_num_threads(n: int) -> None: ...
def prange(*args: int) -> range: ...
