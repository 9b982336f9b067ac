"""The devices of this process, and what they leave in memory."""

import contextlib
import ctypes
import os
from collections.abc import Iterator

import jax


def use_all_cores() -> None:
    """Makes each core of this process a device, so that cells run side by side. Call it before any computation.

    `JAX_NUM_CPU_DEVICES` overrides the number of devices.
    """
    if os.environ.get("JAX_NUM_CPU_DEVICES"):
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jax.config.update("jax_num_cpu_devices", cores)  # noqa: TID251  # only entry points call this


def device_name() -> str:
    """The devices of this process, in words."""
    devices = jax.local_devices()
    return f"{len(devices)} x {devices[0].device_kind}"


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """Computes on the first core of a CPU: a program that all estimators share is compiled once, not for each core."""
    first = jax.local_devices()[0]
    with jax.default_device(first) if first.platform == "cpu" else contextlib.nullcontext():
        yield


def give_memory_back() -> None:
    """Returns the compiler's freed memory to the system; the C library keeps half a gigabyte of a large program."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # not every C library can
        ctypes.CDLL(None).malloc_trim(0)
