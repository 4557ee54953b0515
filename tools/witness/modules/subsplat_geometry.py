"""Cameras, quaternions and footprints as graph nodes. The formulas differ from the crate's: rotation matrices
are products of two quaternion matrices, and areas come from determinants. The graph must be in double
precision.

Conventions: OpenCV axes, poses world from camera, pixel centres at +0.5, quaternions (w, x, y, z) unless
stated otherwise.
"""

import numpy as np


class View:
    """One camera of a graph: pose [4, 4] world from camera, lens [4] = (fx/W, fy/H, cx/W, cy/H)."""

    def __init__(self, g, pose, lens, size):
        self.g, self.width, self.height = g, *size
        self.rotation, self.position = pose[:3, :3], pose[:3, 3]
        self.lens = lens
        self.size = g.const([self.width, self.height])
        self.focal, self.centre = lens[:2] * self.size, lens[2:] * self.size

    def to_camera(self, points):
        """Transforms [..., 3] from world to camera: R^T p - R^T t."""
        shift = self.position.reshape(1, 3) @ self.rotation
        return points @ self.rotation - shift.reshape(3)

    def positions(self, in_camera):
        """Returns projections as fractions of the picture, [..., 2]; for z <= 0 the result is finite and
        meaningless."""
        z = self.g.maximum(in_camera[..., 2:], 1e-5)
        return in_camera[..., :2] / z * self.lens[:2] + self.lens[2:]

    def quat(self):
        """Returns the quaternion wxyz [4] of the rotation; the trace must be well above -1."""
        r = self.rotation
        w = self.g.sqrt(r[0, 0] + r[1, 1] + r[2, 2] + 1.0) * 0.5
        parts = [(r[2, 1] - r[1, 2]) / (4.0 * w), (r[0, 2] - r[2, 0]) / (4.0 * w), (r[1, 0] - r[0, 1]) / (4.0 * w)]
        return self.g.stack([w] + parts, 0)


def is_visible(z, at):
    """Returns [...] bool: in front of the camera (camera z [...]) and inside the picture (positions `at`
    [..., 2])."""
    inside = (z > 1e-5) & (at[..., 0] > 0.0) & (at[..., 0] < 1.0)
    return inside & (at[..., 1] > 0.0) & (at[..., 1] < 1.0)


def parts(q):
    return [q[..., i] for i in range(4)]


def left(g, q):
    """Returns L(q) [..., 4, 4] with q x p = L(q) p."""
    w, x, y, z = parts(q)
    rows = [(w, -x, -y, -z), (x, w, -z, y), (y, z, w, -x), (z, -y, x, w)]
    return g.stack([g.stack(list(r), -1) for r in rows], -2)


def right(g, q):
    """Returns R(q) [..., 4, 4] with p x q = R(q) p."""
    w, x, y, z = parts(q)
    rows = [(w, -x, -y, -z), (x, w, z, -y), (y, -z, w, x), (z, y, -x, w)]
    return g.stack([g.stack(list(r), -1) for r in rows], -2)


def conjugate(g, q):
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def product(g, a, b):
    """Returns the Hamilton product [..., 4]."""
    return (left(g, a) @ b[..., None])[..., 0]


def unit(g, q):
    return q / g.sqrt((q * q).sum(-1, keep=True))


def matrix(g, q):
    """Returns the rotation matrix [..., 3, 3] of a unit quaternion: p -> q p q*."""
    return (left(g, q) @ right(g, conjugate(g, q)))[..., 1:, 1:]


def exponential(g, r):
    """Returns the quaternion of the rotation vector r [..., 3]: cos t/2, sin(t/2)/t r; 1/2 (1 - t^2/24) below
    1e-3."""
    squared = (r * r).sum(-1, keep=True)
    small = squared < 1e-6
    theta = g.sqrt(g.where(small, 1.0, squared))
    share = g.where(small, 0.5 - squared / 48.0, g.unary("Sin", theta * 0.5) / theta)
    return g.concat([g.where(small, 1.0 - squared / 8.0, g.unary("Cos", theta * 0.5)), share * r], -1)


def jacobian(g, p, focal, z_min, low, high):
    """Returns d(u, v)/d(x, y, z) [..., 2, 3] at camera points p [..., 3]; the other arguments broadcast
    against [..., 2] or [..., 1]. z is at least z_min, and x/z and y/z are clamped to low and high."""
    z = g.maximum(p[..., 2:], z_min)
    slope = g.clamp(p[..., :2] / z, low, high)
    f = focal / z
    last = -(f * slope)
    zero = f[..., 0] * 0.0
    rows = [(f[..., 0], zero, last[..., 0]), (zero, f[..., 1], last[..., 1])]
    return g.stack([g.stack(list(r), -1) for r in rows], -2)


def gram(g, m):
    """Returns M M^T [..., 2, 2]."""
    order = list(range(len(m.shape) - 2)) + [len(m.shape) - 1, len(m.shape) - 2]
    return m @ m.transpose(*order)


def det2(c):
    return c[..., 0, 0] * c[..., 1, 1] - c[..., 0, 1] * c[..., 1, 0]


def area(g, m):
    """Returns sqrt det(M M^T), from the determinant."""
    return g.sqrt(g.maximum(det2(gram(g, m)), 0.0) + 1e-24)


def blurred(g, m, lowpass):
    """Returns sqrt det(M M^T + lowpass I)."""
    return g.sqrt(det2(gram(g, m) + np.eye(2) * lowpass))
