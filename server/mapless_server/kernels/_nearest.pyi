import numpy as np
from numpy.typing import NDArray

def nearest(
    length: int,
    first: NDArray[np.int8],
    second: NDArray[np.int8],
    first_inverse_lengths: NDArray[np.float32],
    second_inverse_lengths: NDArray[np.float32],
    nearest: NDArray[np.int32],
    best: NDArray[np.float32],
    second_best: NDArray[np.float32],
    best_of_column: NDArray[np.float32],
    second_of_column: NDArray[np.float32],
    /,
) -> None: ...
def is_fast() -> bool: ...
