"""Z-buffer renderer with exact inverse depth of planes, displaced figures, and antialiased colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.demo.displacement import displacement_map, intersect_figure
from v3d_torch.datasets.demo.scene import Rectangle, Scene
from v3d_torch.datasets.demo.texture_atlas import TextureAtlas
from v3d_torch.datasets.demo.view import OVERSAMPLING, RayGrid, View
from v3d_torch.geometry.camera import PinholeCamera

_FAR_INVERSE_DEPTH = 1e-3
"""Initial value of the z-buffer, 1/m: surfaces beyond 1 km are not drawn."""

_MIN_COSINE = 0.05
"""Smallest cosine of incidence for the texture footprint, so that grazing surfaces are not blurred to one colour."""

_LAYER_RATIO = 0.98
"""Samples of a pixel belong to its nearest surface if their inverse depth is above this fraction of the largest."""

_MIN_PLANE_DISTANCE = 1e-6
"""Planes nearer to the camera centre are edge-on and not drawn, metres; negative distances are back faces."""


@dataclass(frozen=True)
class Rendering:
    """Noise-free image of a scene.

    Attributes:
        colour: RGB in [0, 1], float32, shape :math:`(H, W, 3)`.
        depth: Depth, metres, float32, shape :math:`(H, W)`.
        instance_mask: Id of the person or thing at each pixel, 0 = room, uint8, shape :math:`(H, W)`.
        motion_mask: The same where it moves, 0 = static, uint8, shape :math:`(H, W)`.
    """

    colour: Tensor
    depth: Tensor
    instance_mask: Tensor
    motion_mask: Tensor


class Renderer:
    """Renderer of a scene from any camera pose at any time.

    Args:
        scene: Scene to render; its walls must fill every view.
        camera: Camera without distortion.
    """

    def __init__(self, scene: Scene, camera: PinholeCamera) -> None:
        self.scene, self.camera = scene, camera
        rectangles = [rectangle for body in scene.bodies for rectangle in body.rectangles]
        figures = [figure for body in scene.bodies for figure in body.figures]
        surfaces = [*rectangles, *(figure.plane_at(np.eye(4)) for figure in figures)]
        densities = [r.texture.shape[1] / float(np.linalg.norm(r.across)) for r in surfaces]
        self.textures = TextureAtlas([r.texture for r in surfaces], densities)
        self.displacements = [displacement_map(figure) for figure in figures]
        # The body of each surface: all rectangles come before all figures.
        body_of = [i for i, body in enumerate(scene.bodies) for _ in body.rectangles]
        body_of += [i for i, body in enumerate(scene.bodies) for _ in body.figures]
        self.body_of_surface = torch.tensor(body_of, dtype=torch.int64)
        self.rays = RayGrid.from_camera(camera)

    def __call__(self, T_wc: NDArray[np.float64], time: float) -> Rendering:
        """Render one image.

        Args:
            T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`.
            time: Time, seconds, for the motion of the bodies.

        Returns:
            Colour, depth and masks.
        """
        view = View(self.rays, T_wc)
        poses = [body.motion(time) for body in self.scene.bodies]
        inverse_depth, surface, forms = self._draw_rectangles(view, poses)
        form = forms.index_select(0, surface.flatten()).reshape(*surface.shape, -1)  # (S, H, W, 10)
        x, y = self.rays.x, self.rays.y
        s = (form[..., 3] * x + form[..., 4] * y + form[..., 5]) / inverse_depth
        t = (form[..., 6] * x + form[..., 7] * y + form[..., 8]) / inverse_depth
        # The cosine of incidence is plane distance * inverse depth. Its square root is a compromise between blur along
        # the surface and aliasing across the slant.
        footprint = (inverse_depth * form[..., 9]).clamp_(min=_MIN_COSINE).rsqrt_() / inverse_depth
        figures = [(f, T_wb) for body, T_wb in zip(self.scene.bodies, poses, strict=True) for f in body.figures]
        for i, (figure, T_wb) in enumerate(figures):
            hits = intersect_figure(figure, self.displacements[i], view, T_wb, time)
            if hits is None:
                continue
            figure_inverse_depth = 1.0 / hits.depth
            visible = hits.inside & (figure_inverse_depth > inverse_depth[hits.window])
            for buffer, value in (
                (inverse_depth, figure_inverse_depth),
                (s, hits.s),
                (t, hits.t),
                (footprint, hits.depth),
            ):
                torch.where(visible, value, buffer[hits.window], out=buffer[hits.window])
            surface[hits.window].masked_fill_(visible, len(forms) + i)
        footprint /= OVERSAMPLING * self.camera.fx
        colour = self.textures(surface.flatten(), s.flatten(), t.flatten(), footprint.flatten())
        return self._resolve_samples(colour.reshape(*surface.shape, 3), inverse_depth, surface, time)

    def _draw_rectangles(self, view: View, poses: list[NDArray[np.float64]]) -> tuple[Tensor, Tensor, Tensor]:
        """Draw all rectangles to a z-buffer.

        Args:
            view: Camera rays.
            poses: Body-to-world pose of each body.

        Returns:
            Inverse depth, float32, and index of the nearest rectangle, int32, both of shape :math:`(S, H, W)`; linear
            forms of all rectangles (see `_linear_forms`), float32, shape :math:`(R, 10)`.
        """
        size = (OVERSAMPLING**2, self.camera.height, self.camera.width)
        inverse_depth, surface = torch.full(size, _FAR_INVERSE_DEPTH), torch.zeros(size, dtype=torch.int32)
        rectangles = [
            rectangle.transform(T_wb)
            for body, T_wb in zip(self.scene.bodies, poses, strict=True)
            for rectangle in body.rectangles
        ]
        forms = np.zeros((len(rectangles), 10), np.float32)
        for i, rectangle in enumerate(rectangles):
            window = view.visible_window(rectangle.corners)
            form = _linear_forms(rectangle, view)
            if window is None or form is None:
                continue
            forms[i] = form
            w, s, t = (view.dot_rays(form[k : k + 3], window) for k in (0, 3, 6))
            nearest = inverse_depth[window]
            visible = (w > nearest) & (s >= 0) & (s <= w) & (t >= 0) & (t <= w)
            torch.where(visible, w, nearest, out=nearest)
            surface[window].masked_fill_(visible, i)
        return inverse_depth, surface, torch.from_numpy(forms)

    def _resolve_samples(self, colour: Tensor, inverse_depth: Tensor, surface: Tensor, time: float) -> Rendering:
        """Reduce samples to pixels: average the colours, and take depth and ids from the nearest surface only."""
        nearest, nearest_sample = inverse_depth.max(dim=0, keepdim=True)
        # The samples of a plane are symmetric about the pixel centre and 1/z is linear, so their mean is exact.
        is_nearest = (inverse_depth > _LAYER_RATIO * nearest).to(torch.float32)
        depth = is_nearest.sum(0) / (inverse_depth * is_nearest).sum(0)
        body = self.body_of_surface[surface.gather(0, nearest_sample)[0]]
        bodies = self.scene.bodies
        instances = torch.tensor([body.instance for body in bodies], dtype=torch.uint8)
        moving = torch.tensor([body.instance > 0 and body.is_moving(time) for body in bodies], dtype=torch.uint8)
        return Rendering(colour.mean(0), depth, instances[body], (instances * moving)[body])


def _linear_forms(rectangle: Rectangle, view: View) -> NDArray[np.float64] | None:
    """Coefficients of 1/z, s/z and t/z over (x, y, 1), and the distance of the plane; None for a back face.

    A ray r meets the plane at z (n.r) = n.o, so that 1/z is linear in r, and with it s/z and t/z.
    """
    origin = view.transform_to_camera(np.asarray(rectangle.corner, float))
    across, down, normal = (
        view.rotate_to_camera(np.asarray(v, float)) for v in (rectangle.across, rectangle.down, rectangle.normal)
    )
    distance = -float(normal @ origin)
    if distance < _MIN_PLANE_DISTANCE:
        return None
    w = -normal / distance
    return np.concatenate([w, *((e - w * (origin @ e)) / (e @ e) for e in (across, down)), [distance]])
