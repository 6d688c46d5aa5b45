"""NVRTC, NVIDIA's compiler of CUDA's C++, which PyTorch brings along."""

from __future__ import annotations

import ctypes
import site
import sys
from functools import cache
from pathlib import Path

import torch


def compiled(text: str, architecture: str) -> bytes:
    """The machine code of a source, by NVRTC; raises OSError without it, RuntimeError with its first words."""
    nvrtc = _nvrtc()
    program = ctypes.c_void_p()
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"coop.cu", 0, None, None)
    options = [f"--gpu-architecture={architecture}".encode(), b"--fmad=true"]
    status = nvrtc.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options))
    size = ctypes.c_size_t()
    if status:
        nvrtc.nvrtcGetProgramLogSize(program, ctypes.byref(size))
        log = ctypes.create_string_buffer(size.value)
        nvrtc.nvrtcGetProgramLog(program, log)
        raise RuntimeError(f"NVRTC: {log.value.decode(errors='replace').strip()[:500]}")
    nvrtc.nvrtcGetCUBINSize(program, ctypes.byref(size))
    code = ctypes.create_string_buffer(size.value)
    nvrtc.nvrtcGetCUBIN(program, code)
    nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    return code.raw


@cache
def _nvrtc() -> ctypes.CDLL:
    """NVRTC of PyTorch's CUDA, wherever its package has put it."""
    major = (torch.version.cuda or "13").partition(".")[0]
    name = f"libnvrtc.so.{major}"
    folders = {*site.getsitepackages(), site.getusersitepackages(), *sys.path, str(Path(torch.__file__).parents[1])}
    found = [path for folder in sorted(folders) for path in Path(folder).glob(f"nvidia/*/lib/{name}")]
    found += [Path(torch.__file__).parent / "lib" / name, Path("/usr/local/cuda/lib64") / name]
    for path in (name, *map(str, found)):
        try:
            return ctypes.CDLL(path)
        except OSError:
            continue
    raise OSError(f"{name} is not found")
