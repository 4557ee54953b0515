"""Prints what OpenCV says of a few rays through distorted lenses, for the table in
src/files/photos/undistort.rs (`distort_is_opencvs`).

    pip install numpy opencv-python-headless && python tools/make_distortion_golden.py
"""

import cv2
import numpy as np

RAYS = [(0.3, -0.2), (-0.5, 0.4), (0.0, 0.0), (0.7, 0.1)]
# k1 k2 p1 p2 k3 k4 k5 k6 in OpenCV's order.
BROWN = [
    [0.0578421, -0.0805099, -0.000980296, 0.00015575, 0, 0, 0, 0],
    [-0.2, 0.05, 0.01, -0.02, 0.03, 0, 0, 0],
    [0.3, 0.1, 0.003, 0.004, -0.02, 0.5, 0.05, 0.01],
]
FISHEYE = [[0.0, 0.0, 0.0, 0.0], [0.02, -0.01, 0.005, -0.002]]

print(f"OpenCV {cv2.__version__}")
points = np.array([[[x, y, 1.0]] for x, y in RAYS])
none = np.zeros(3)
for coefficients in BROWN:
    out, _ = cv2.projectPoints(points, none, none, np.eye(3), np.array(coefficients, dtype=float))
    print("brown", coefficients, [[f"{v:.9f}" for v in p[0]] for p in out])
for coefficients in FISHEYE:
    out, _ = cv2.fisheye.projectPoints(points, none, none, np.eye(3), np.array(coefficients, dtype=float))
    print("fisheye", coefficients, [[f"{v:.9f}" for v in p[0]] for p in out])
