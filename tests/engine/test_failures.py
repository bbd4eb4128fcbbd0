"""Failures: of the job, of its input, of the device."""

from collections.abc import Callable

import numpy as np
import pytest

from mapless_server import errors
from mapless_server.engine.failures import failure_of
from mapless_server.scheduling import Failure

LOST = [
    "CUDA error: an illegal memory access was encountered\nCUDA kernel errors might be asynchronously reported",
    "CUDA error: device-side assert triggered",
    "CUDA error: unspecified launch failure",
    "CUDA error: uncorrectable ECC error encountered",
    "CUDA error: CUBLAS_STATUS_EXECUTION_FAILED when calling `cublasSgemm( handle, opa, opb, m, n, k)`",
    "CUDA error: CUBLAS_STATUS_INTERNAL_ERROR when calling `cublasCreate(handle)`",
    "cuDNN error: CUDNN_STATUS_EXECUTION_FAILED",
]
FULL = [
    "CUDA out of memory. Tried to allocate 20.00 MiB. GPU 0 has a total capacity of 139.81 GiB",
    "CUDA error: out of memory",
    "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`",
    "cuDNN error: CUDNN_STATUS_ALLOC_FAILED",
]
HARMLESS = [
    "mat1 and mat2 shapes cannot be multiplied (3x4 and 5x6)",
    "Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu!",
    "",
]


def caught(raises: Callable[[], object]) -> BaseException:
    with pytest.raises(BaseException) as info:  # noqa: PT011  whatever it is
        raises()
    return info.value


@pytest.mark.parametrize("message", LOST)
def test_a_poisoned_context_is_the_end_of_the_device(message: str) -> None:
    assert failure_of(RuntimeError(message)) is Failure.DEVICE_LOST


@pytest.mark.parametrize("message", FULL)
def test_a_full_device_is_not(message: str) -> None:
    """The same words, "CUDA error", and after it everything works again."""
    assert failure_of(RuntimeError(message)) is Failure.OUT_OF_MEMORY


@pytest.mark.parametrize("message", HARMLESS)
def test_a_fault_in_our_own_arithmetic_is_of_the_item(message: str) -> None:
    assert failure_of(RuntimeError(message)) is Failure.JOB_FAILED


@pytest.mark.parametrize("message", [*LOST, *FULL])
def test_the_text_alone_does_nothing_in_another_exception_type(message: str) -> None:
    """A caller may send a scene of that name."""
    assert failure_of(ValueError(message)) is Failure.JOB_FAILED
    assert failure_of(errors.InvalidArgument(message)) is Failure.BAD_INPUT


@pytest.mark.parametrize(
    "kind", [it for it in vars(errors).values() if isinstance(it, type) and issubclass(it, errors.RequestError)]
)
def test_only_errors_the_caller_can_fix_are_of_the_request(kind: type[errors.RequestError]) -> None:
    """Damaged bytes in the store, or a scene that is being emptied, are reported to the caller, and not its fault."""
    of_server = kind.__name__ in ("RequestError", "Overloaded", "DeadlineExceeded", "Unavailable", "DataLoss")
    assert failure_of(kind("text")) is (Failure.JOB_FAILED if of_server else Failure.BAD_INPUT)


def test_memory_of_the_host() -> None:
    assert failure_of(MemoryError()) is Failure.OUT_OF_MEMORY
    assert failure_of(caught(lambda: np.zeros(2**56, np.uint8))) is Failure.OUT_OF_MEMORY  # a kind of its own


def test_an_earlier_handled_failure_does_not_affect_this_one() -> None:
    def handle() -> None:
        try:
            raise RuntimeError(LOST[0])
        except RuntimeError as lost:
            raise errors.InvalidArgument("another matter") from lost

    assert failure_of(caught(handle)) is Failure.BAD_INPUT


class TestTorch:
    """With the classes that torch raises."""

    def test_out_of_memory(self) -> None:
        torch = pytest.importorskip("torch", reason="the networks' extra is not installed")
        assert failure_of(torch.OutOfMemoryError("CUDA out of memory. Tried to allocate")) is Failure.OUT_OF_MEMORY
        assert failure_of(torch.cuda.OutOfMemoryError("whatever it says")) is Failure.OUT_OF_MEMORY

    def test_an_accelerator_error(self) -> None:
        torch = pytest.importorskip("torch", reason="the networks' extra is not installed")
        if not hasattr(torch, "AcceleratorError"):
            pytest.skip("torch is too old")
        assert failure_of(torch.AcceleratorError(LOST[0])) is Failure.DEVICE_LOST
        assert failure_of(torch.AcceleratorError("a text of a later version")) is Failure.DEVICE_LOST
        assert failure_of(torch.AcceleratorError("CUDA error: out of memory")) is Failure.OUT_OF_MEMORY

    def test_memory_of_the_host(self) -> None:
        """Torch says it with a RuntimeError of its own words."""
        torch = pytest.importorskip("torch", reason="the networks' extra is not installed")
        assert failure_of(caught(lambda: torch.empty(2**60))) is Failure.OUT_OF_MEMORY
