"""Z-buffer renderer: exact inverse depth of planes and relief figures, antialiased colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.demo.geometry import Rectangle, Scene
from v3d_torch.datasets.demo.relief import intersect, relief_map
from v3d_torch.datasets.demo.texturing import TextureTable
from v3d_torch.datasets.demo.view import OVERSAMPLING, Rays, View
from v3d_torch.geometry.camera import PinholeCamera


@dataclass(frozen=True)
class Rendering:
    """What an ideal camera would deliver.

    Attributes:
        colour: RGB in [0, 1], float32, shape :math:`(H, W, 3)`.
        depth: metres, float32, shape :math:`(H, W)`.
        mover: id of the moving figure at each pixel, 0 = static, uint8, shape :math:`(H, W)`.
    """

    colour: Tensor
    depth: Tensor
    mover: Tensor


class Renderer:
    """Renders a scene from any pose at any time.

    Args:
        scene: the room; its walls must close the view.
        camera: without distortion.
    """

    def __init__(self, scene: Scene, camera: PinholeCamera) -> None:
        self.scene, self.camera = scene, camera
        surfaces = [*scene.rectangles, *(figure.rectangle(0.0)[0] for figure in scene.figures)]
        densities = [r.texture.shape[1] / float(np.linalg.norm(r.across)) for r in surfaces]
        self.textures = TextureTable([r.texture for r in surfaces], densities)
        self.reliefs = [relief_map(figure) for figure in scene.figures]
        self.movers = torch.tensor([0] * len(scene.rectangles) + [f.mover for f in scene.figures], dtype=torch.uint8)
        self.rays = Rays.of(camera)

    def __call__(self, T_wc: NDArray[np.float64], time: float) -> Rendering:
        """Render.

        Args:
            T_wc: camera-to-world, shape :math:`(4, 4)`.
            time: seconds; the people move.

        Returns:
            Colour, depth and the truth of what moves.
        """
        view = View(self.rays, T_wc)
        inverse_depth, surface, forms = self._planes(view)
        form = forms.index_select(0, surface.flatten()).reshape(*surface.shape, -1)  # (S, H, W, 10)
        x, y = self.rays.x, self.rays.y
        s = (form[..., 3] * x + form[..., 4] * y + form[..., 5]) / inverse_depth
        t = (form[..., 6] * x + form[..., 7] * y + form[..., 8]) / inverse_depth
        # The cosine of incidence is distance / z: its root balances blur along against aliasing across the slant.
        footprint = (inverse_depth * form[..., 9]).clamp_(min=0.05).rsqrt_() / inverse_depth
        for i, figure in enumerate(self.scene.figures):
            hits = intersect(figure, self.reliefs[i], view, time)
            if hits is None:
                continue
            closer = 1.0 / hits.depth
            seen = hits.inside & (closer > inverse_depth[hits.window])
            for buffer, value in ((inverse_depth, closer), (s, hits.s), (t, hits.t), (footprint, hits.depth)):
                torch.where(seen, value, buffer[hits.window], out=buffer[hits.window])
            surface[hits.window].masked_fill_(seen, len(self.scene.rectangles) + i)
        footprint /= OVERSAMPLING * self.camera.fx
        colour = self.textures(surface.flatten(), s.flatten(), t.flatten(), footprint.flatten())
        return self._resolve(colour.reshape(*surface.shape, 3), inverse_depth, surface)

    def _planes(self, view: View) -> tuple[Tensor, Tensor, Tensor]:
        """Inverse depth and index of the nearest rectangle; rows of the rectangles' linear forms."""
        size = (OVERSAMPLING**2, self.camera.height, self.camera.width)
        inverse_depth, surface = torch.full(size, 1e-3), torch.zeros(size, dtype=torch.int32)
        forms = np.zeros((len(self.scene.rectangles), 10), np.float32)
        for i, rectangle in enumerate(self.scene.rectangles):
            corner, across, down = (np.asarray(v, float) for v in (rectangle.corner, rectangle.across, rectangle.down))
            window = view.window(np.stack([corner, corner + across, corner + down, corner + across + down]))
            form = _linear_forms(rectangle, view)
            if window is None or form is None:
                continue
            forms[i] = form
            w, s, t = (view.along(form[k : k + 3], window) for k in (0, 3, 6))
            nearest = inverse_depth[window]
            seen = (w > nearest) & (s >= 0) & (s <= w) & (t >= 0) & (t <= w)
            torch.where(seen, w, nearest, out=nearest)
            surface[window].masked_fill_(seen, i)
        return inverse_depth, surface, torch.from_numpy(forms)

    def _resolve(self, colour: Tensor, inverse_depth: Tensor, surface: Tensor) -> Rendering:
        """Samples to pixels: colours are averaged; depth and id come from the nearest layer alone."""
        nearest, which = inverse_depth.max(dim=0, keepdim=True)
        # A plane's samples lie symmetric about the pixel's centre and 1/z is linear: their mean is exact there.
        near = (inverse_depth > 0.98 * nearest).to(torch.float32)
        depth = near.sum(0) / (inverse_depth * near).sum(0)
        return Rendering(colour.mean(0), depth, self.movers[surface.gather(0, which)[0]])


def _linear_forms(rectangle: Rectangle, view: View) -> NDArray[np.float64] | None:
    """Coefficients of 1/z, s/z and t/z over (x, y, 1), and the plane's distance; None when seen from behind.

    A ray r meets the plane where z (n.r) = n.o, so that 1/z, and with it s/z and t/z, is linear in r.
    """
    origin = view.point(np.asarray(rectangle.corner, float))
    across, down, normal = (
        view.direction(np.asarray(v, float)) for v in (rectangle.across, rectangle.down, rectangle.normal)
    )
    distance = -float(normal @ origin)
    if distance < 1e-6:
        return None
    w = -normal / distance
    return np.concatenate([w, *((e - w * (origin @ e)) / (e @ e) for e in (across, down)), [distance]])
