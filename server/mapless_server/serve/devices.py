"""The device that networks compute on."""

import ctypes


def choose_device(device: str) -> str:
    """Chooses the device of networks; `auto` is a CUDA device if torch is installed and finds one, else the CPU.

    ValueError if there is no such device.
    """
    chosen = _find_device(device)
    if chosen != "cpu":
        import torch

        # On new GPUs torch prefers cuDNN's attention, which plans for half a second for each new number of keypoints of
        # LightGlue. To be set before there are threads.
        torch.backends.cuda.enable_cudnn_sdp(False)
    return chosen


def _find_device(device: str) -> str:
    if device == "cpu" or (device == "auto" and not _has_driver()):
        return "cpu"
    try:
        import torch
    except ImportError:
        if device == "auto":
            return "cpu"
        raise
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if torch.device(device).index not in (None, *range(torch.cuda.device_count())) or not torch.cuda.is_available():
        raise ValueError(f"there is no device {device}: torch finds {torch.cuda.device_count()} CUDA devices")
    return device


def _has_driver() -> bool:
    """Whether NVIDIA's driver is installed: without it there is no CUDA device, and torch need not be loaded."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True
