"""Sky, light and the texture of the ground."""

from __future__ import annotations

import mujoco

GROUND_MATERIAL = "ground"
HORIZON = (0.86, 0.91, 0.96)
_ZENITH = (0.36, 0.58, 0.85)


def add_light(spec: mujoco.MjSpec, middle: tuple[float, float, float]) -> None:
    """Adds a light that casts shadows, a sky, and the material with which renderers grain the ground.

    No geom has the material, which takes precedence over a geom's colour in some programs.
    """
    spec.worldbody.add_light(
        pos=middle,
        dir=(0.2, 0.3, -1),
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=True,
        diffuse=(0.6, 0.6, 0.6),
    )
    visual = spec.visual
    visual.headlight.ambient = (0.45, 0.45, 0.45)
    visual.headlight.diffuse = (0.35, 0.35, 0.35)
    visual.quality.shadowsize = 4096
    visual.global_.offwidth, visual.global_.offheight = 1920, 1080
    visual.rgba.haze = (*HORIZON, 1.0)
    texture, builtin = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.add_texture(
        name="sky",
        type=texture.mjTEXTURE_SKYBOX,
        builtin=builtin.mjBUILTIN_GRADIENT,
        rgb1=_ZENITH,
        rgb2=HORIZON,
        width=128,
        height=768,
    )
    spec.add_texture(
        name=GROUND_MATERIAL,
        type=texture.mjTEXTURE_2D,
        builtin=builtin.mjBUILTIN_FLAT,
        mark=mujoco.mjtMark.mjMARK_RANDOM,
        random=0.2,
        rgb1=(1.0, 1.0, 1.0),
        rgb2=(1.0, 1.0, 1.0),
        markrgb=(0.93, 0.93, 0.93),
        width=256,
        height=256,
    )
    material = spec.add_material(name=GROUND_MATERIAL, texuniform=True, texrepeat=(1.0, 1.0), specular=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = GROUND_MATERIAL
