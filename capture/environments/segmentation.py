"""Which object each pixel shows, drawn by the same context and with the same options as the picture.

robosuite's own segmentation sensors fail with numpy 2. A second renderer would create a second OpenGL context, and
robosuite, which never makes its own context current again, would then draw into that one. Therefore the context of the
picture draws the scene a second time, in identity colours.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray


def owners_of_bodies(parents: NDArray[np.integer], roots: Mapping[int, int], background: int) -> NDArray[np.int32]:
    """Return (body,) the object index of every body: that of the body itself or of its nearest ancestor in `roots`.

    parents: (body,) parent of every body. In MuJoCo a parent has a lower number than its children, and the world is its
        own parent.
    roots: body -> object index. Bodies below none of the roots get the index `background`.
    """
    owners = np.full(len(parents), background, dtype=np.int32)
    for body, parent in enumerate(parents):
        owners[body] = roots.get(body, background if body == parent else owners[parent])
    return owners


def decode_identities(colours: NDArray[np.uint8], table: NDArray[np.int32]) -> NDArray[np.int32]:
    """Map identity colours (height, width, 3) to entries of `table`, (height, width): colour k to table[k].

    Colour 0 means that nothing was drawn.
    """
    wide = colours.astype(np.int32)
    identity = wide[:, :, 0] + (wide[:, :, 1] << 8) + (wide[:, :, 2] << 16)
    if identity.max() >= len(table):
        # The driver blended colours at edges (multisampling) although identity colours were requested.
        raise RuntimeError(f"The renderer returned identity {identity.max()}; only {len(table) - 1} things were drawn.")
    entries: NDArray[np.int32] = table[identity]
    return entries


def draw_object_indices(
    context: Any, data: mujoco.MjData, camera_id: int, size: int, owners: NDArray[np.int32], background: int
) -> NDArray[np.int32]:
    """Draw the object indices (size, size) of the state in `data` with robosuite's offscreen `context`.

    The context must be current. Its options do not change (LIBERO and robosuite show the visual geoms, group 1, and
    hide the collision geoms, group 0), so the labels cover exactly what the picture shows. The result has the
    orientation of the
    picture: OpenGL's, row 0 at the bottom.
    """
    model, scene = context.model._model, context.scn
    context.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
    context.cam.fixedcamid = camera_id
    mujoco.mjv_updateScene(
        model, data, context.vopt, context.pert, context.cam, mujoco.mjtCatBit.mjCAT_ALL.value, scene
    )
    table = identity_table(model, scene, owners, background)
    colours = np.empty((size, size, 3), dtype=np.uint8)
    viewport = mujoco.MjrRect(0, 0, size, size)
    flags = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)
    for flag in flags:
        scene.flags[flag] = 1
    try:
        mujoco.mjr_render(viewport, scene, context.con)
        mujoco.mjr_readPixels(colours, None, viewport, context.con)
    finally:
        for flag in flags:
            scene.flags[flag] = 0
    return decode_identities(colours, table)


def identity_table(
    model: mujoco.MjModel, scene: mujoco.MjvScene, owners: NDArray[np.int32], background: int
) -> NDArray[np.int32]:
    """Return the object index of every identity colour, (colour,), and remove invisible things from the scene.

    robosuite hides helper sites (such as a ray below the gripper) with a negative opacity; they remain in the scene.
    Identity colours ignore opacity, so these sites would cover objects that the picture shows.
    """
    table = np.full(scene.ngeom + 1, background, dtype=np.int32)
    bodies_of = {mujoco.mjtObj.mjOBJ_GEOM.value: model.geom_bodyid, mujoco.mjtObj.mjOBJ_SITE.value: model.site_bodyid}
    for drawn in scene.geoms[: scene.ngeom]:
        if drawn.rgba[3] <= 0:
            drawn.segid = -1  # not drawn in this picture; the scene is built again for the next one
            continue
        bodies = bodies_of.get(drawn.objtype)
        if drawn.segid >= 0 and bodies is not None:
            table[drawn.segid + 1] = owners[bodies[drawn.objid]]
    return table
