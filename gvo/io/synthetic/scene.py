"""Scenes of textured rectangles in daylight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gvo.io.synthetic.textures import Texture, TextureAtlas
from gvo.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rectangle:
    """A flat textured rectangle; seen from its front, `edge_s` is to the right of `edge_t`.

    Parameters
    ----------
    corner : array_like, shape (3,)
        Where the texture starts (its upper left corner), `map` frame, metres.
    edge_s, edge_t : array_like, shape (3,)
        The edges along the rows and the columns of the texture, perpendicular, metres.
    texture : str
        Name of the texture.
    offset_m : (float, float)
        Where in the texture the corner lies, metres.
    is_stretched : bool
        One period of the texture covers the whole rectangle.
    is_two_sided : bool
        Seen from behind as well.
    is_lit : bool
        Shaded by the direction of the light.
    gain : float
        Factor on the brightness.
    """

    corner: ArrayLike
    edge_s: ArrayLike
    edge_t: ArrayLike
    texture: str
    offset_m: tuple[float, float] = (0.0, 0.0)
    is_stretched: bool = False
    is_two_sided: bool = False
    is_lit: bool = True
    gain: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Light:
    """Daylight: a direction, an ambient share, and haze.

    Parameters
    ----------
    direction : (float, float, float)
        Towards the light, `map` frame.
    ambient : float
        Brightness of surfaces turned away from the light.
    direct : float
        What is added to it for surfaces facing the light.
    haze_m : float
        Distance in which contrast falls to 1/e, metres.
    haze_grey : float
        Grey value of the haze, and of pixels that see nothing.
    """

    direction: tuple[float, float, float] = (0.3, -0.4, 0.85)
    ambient: float = 0.7
    direct: float = 0.4
    haze_m: float = np.inf
    haze_grey: float = 200.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """n rectangles as arrays, ready to be rendered.

    Parameters
    ----------
    origins : ndarray of float64, shape (n, 3)
        The corners where the textures start, `map` frame, metres.
    axes_s, axes_t : ndarray of float64, shape (n, 3)
        Unit vectors along the rows and the columns of the textures, `map` frame.
    sizes : ndarray of float64, shape (n, 2)
        Along these axes, metres.
    is_two_sided : ndarray of bool, shape (n,)
        Seen from behind as well.
    textures : ndarray of int64, shape (n,)
        Indices into the atlas.
    texels_per_m, texel_offsets : ndarray of float64, shape (n, 2)
        Resolution, and the texel at the origin.
    has_mask : ndarray of bool, shape (n,)
        The texture is transparent in places.
    gains : ndarray of float64, shape (n,)
        Factors on the brightness.
    atlas : TextureAtlas
    light : Light
    """

    origins: FloatArray
    axes_s: FloatArray
    axes_t: FloatArray
    sizes: FloatArray
    is_two_sided: BoolArray
    textures: IntArray
    texels_per_m: FloatArray
    texel_offsets: FloatArray
    has_mask: BoolArray
    gains: FloatArray
    atlas: TextureAtlas
    light: Light


def make_scene(
    rectangles: Sequence[Rectangle], textures: Mapping[str, Texture], light: Light
) -> Scene:
    """Put rectangles and the textures they name together.

    Parameters
    ----------
    rectangles : sequence of Rectangle
        In the map frame.
    textures : mapping of str to Texture
        Of one size, by the names that the rectangles use.
    light : Light
        Of the whole scene.

    Returns
    -------
    Scene

    Raises
    ------
    ValueError
        Edges that are not perpendicular or have no length, textures of different sizes.
    """
    names = {name: k for k, name in enumerate(textures)}
    atlas = TextureAtlas(list(textures.values()))
    axes_s, widths = _unit_vectors([r.edge_s for r in rectangles])
    axes_t, heights = _unit_vectors([r.edge_t for r in rectangles])
    if np.any(np.abs(np.einsum("ij,ij->i", axes_s, axes_t)) > 1e-6):
        raise ValueError("the edges of a rectangle must be perpendicular")
    sizes = np.stack([widths, heights], axis=1)
    is_stretched = np.array([r.is_stretched for r in rectangles])[:, np.newaxis]
    periods = np.array([textures[r.texture].size_m for r in rectangles])
    texels_per_m = atlas.size / np.where(is_stretched, sizes, periods)
    return Scene(
        origins=np.array([r.corner for r in rectangles], dtype=np.float64),
        axes_s=axes_s,
        axes_t=axes_t,
        sizes=sizes,
        is_two_sided=np.array([r.is_two_sided for r in rectangles]),
        textures=np.array([names[r.texture] for r in rectangles]),
        texels_per_m=texels_per_m,
        texel_offsets=texels_per_m * [r.offset_m for r in rectangles],
        has_mask=np.array([textures[r.texture].mask is not None for r in rectangles]),
        gains=_gains(rectangles, np.cross(axes_s, axes_t), light),
        atlas=atlas,
        light=light,
    )


def _unit_vectors(edges: Sequence[ArrayLike]) -> tuple[FloatArray, FloatArray]:
    vectors = np.array(edges, dtype=np.float64)
    lengths = np.linalg.norm(vectors, axis=1)
    if np.any(lengths == 0):
        raise ValueError("the edges of a rectangle must not be zero")
    return vectors / lengths[:, np.newaxis], lengths


def _gains(rectangles: Sequence[Rectangle], inward: FloatArray, light: Light) -> FloatArray:
    """Return each rectangle's brightness; `inward` are the normals away from the viewer."""
    direction = np.array(light.direction) / np.linalg.norm(light.direction)
    facing = np.maximum(-inward @ direction, 0.0)
    lit = light.ambient + light.direct * facing
    return np.array(
        [r.gain * (g if r.is_lit else 1.0) for r, g in zip(rectangles, lit, strict=True)]
    )
