"""Convert addresses to arrays, so that one compiled kernel supports any number of tensors."""

from typing import Any

from numba import types
from numba.extending import intrinsic


@intrinsic
def float32_pointer(typing_context: Any, address: Any) -> Any:  # noqa: ANN401, ARG001
    """Convert an int64 address to a float32 pointer for `numba.carray`, inside kernels."""
    signature = types.CPointer(types.float32)(types.int64)  # type: ignore[no-untyped-call]

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return signature, codegen
