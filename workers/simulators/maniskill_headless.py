"""Lets ManiSkill build its scenes on a machine without a Vulkan device.

SAPIEN's loader makes a render material for every part of a robot even where nothing is rendered, and a material needs a
device. There, materials are replaced by ones that only hold what they are given; all pictures are drawn by MuJoCo.
"""

from typing import Any

from workers.simulators.robot_packages import load

MATERIALS = ("RenderMaterial", "RenderTexture2D")
MODULES = ("sapien.render", "sapien.pysapien.render", "sapien.wrapper.urdf_loader")  # each holds the classes by name


class InertMaterial:
    """Takes whatever a material is given, and does nothing with it."""

    def __init__(self, *arguments: object, **settings: object) -> None:
        del arguments
        vars(self).update(settings)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("set_"):
            return lambda *arguments: None
        raise AttributeError(name)


def do_without_vulkan() -> None:
    """Replaces the materials, if there is no device that real ones could live on."""
    if _can_make_materials():
        return
    for module in map(load, MODULES):
        for name in MATERIALS:
            setattr(module, name, InertMaterial)


def _can_make_materials() -> bool:
    try:
        load("sapien.render").RenderMaterial()
    except RuntimeError:  # failed to find a rendering device
        return False
    return True
