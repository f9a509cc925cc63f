"""A simulator's drawing context, kept from one reset to the next.

Every reset of robosuite reads the scene anew and makes a drawing context for it, which uploads all meshes and
textures: half of a reset's time. Between the resets of a task nothing differs but where cabinets and the like stand,
which is read from the model for every picture. So the context goes on with the new model if everything else is the
same; the pictures are the same to the bit.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

#: What may differ: places of bodies in their parents, and colours of helper sites, which robosuite hides after a reset.
#: Both are read for every picture.
_READ_FOR_EVERY_PICTURE = ("body_pos", "body_quat", "site_rgba")
#: The number of things that a scene may hold, as in robosuite.
_MOST_DRAWN = 1000


class KeptContext:
    """Keeps the drawing context of `simulator` (not yet initialised) when robosuite frees the rest of a scene."""

    def __init__(self, simulator: Any) -> None:
        # Methods of the instance, not a derived class: see `CameraGate.attach`.
        self._simulator = simulator
        self._kept: Any = None
        self._destroy, self._initialize = simulator._destroy_sim, simulator._initialize_sim
        simulator._destroy_sim, simulator._initialize_sim = self._destroy_scene, self._initialize_scene

    def free(self) -> None:
        """Free the context if it is kept; afterwards nothing is."""
        if self._kept is not None:
            self._kept.gl_ctx.make_current()  # OpenGL frees names in the current context
            self._kept = None

    def _destroy_scene(self) -> None:
        context = getattr(self._simulator.sim, "_render_context_offscreen", None)
        if context is not None:
            self._kept, context.sim, context.data = context, None, None
            self._simulator.sim._render_context_offscreen = None
        self._destroy()

    def _initialize_scene(self, *given: Any, **options: Any) -> None:
        self._initialize(*given, **options)
        context, simulation = self._kept, self._simulator.sim
        if context is None or not self._simulator.has_offscreen_renderer:
            return
        if not draw_alike(context.model._model, simulation.model._model):
            self.free()  # robosuite makes another one
            return
        self._kept = None
        simulation.forward()  # as where a context is made
        context.sim, context.model, context.data = simulation, simulation.model, simulation.data
        context.scn = mujoco.MjvScene(simulation.model._model, maxgeom=_MOST_DRAWN)
        context.cam, context.vopt, context.pert = mujoco.MjvCamera(), mujoco.MjvOption(), mujoco.MjvPerturb()
        simulation.add_render_context(context)


def draw_alike(one: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Tell whether one drawing context serves both models: all is the same but what is read for every picture."""
    for name in dir(one):
        if name.startswith("_") or name in _READ_FOR_EVERY_PICTURE or callable(mine := getattr(one, name)):
            continue
        its = getattr(other, name)
        if not (np.array_equal(mine, its) if isinstance(mine, np.ndarray) else mine == its):
            return False
    return True
