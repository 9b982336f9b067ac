"""The devices of this process."""

import os

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
