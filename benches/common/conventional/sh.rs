//! Spherical harmonics of degree ≤ 4, 3DGS signs, and their derivatives by x, y, z.

const C1: f32 = 0.488_602_52;
const C2: [f32; 3] = [1.092_548_5, 0.315_391_57, 0.546_274_24];
const C3: [f32; 5] = [0.590_043_6, 2.890_611_4, 0.457_045_8, 0.373_176_34, 1.445_305_7];
const C4: [f32; 6] = [2.503_343, 1.770_130_8, 0.946_174_7, 0.669_046_5, 0.105_785_55, 0.473_087_34];
const C44: f32 = 0.625_835_7;

/// Returns the functions at the unit vector `d`; those above `degree` are 0.
pub fn basis(degree: usize, [x, y, z]: [f32; 3]) -> [f32; 25] {
    let mut b = [0.0; 25];
    b[0] = 0.282_094_8;
    if degree == 0 {
        return b;
    }
    (b[1], b[2], b[3]) = (-C1 * y, C1 * z, -C1 * x);
    if degree == 1 {
        return b;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    b[4] = C2[0] * x * y;
    b[5] = -C2[0] * y * z;
    b[6] = C2[1] * (2.0 * zz - xx - yy);
    b[7] = -C2[0] * x * z;
    b[8] = C2[2] * (xx - yy);
    if degree == 2 {
        return b;
    }
    b[9] = -C3[0] * y * (3.0 * xx - yy);
    b[10] = C3[1] * x * y * z;
    b[11] = -C3[2] * y * (4.0 * zz - xx - yy);
    b[12] = C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
    b[13] = -C3[2] * x * (4.0 * zz - xx - yy);
    b[14] = C3[4] * z * (xx - yy);
    b[15] = -C3[0] * x * (xx - 3.0 * yy);
    if degree == 3 {
        return b;
    }
    b[16] = C4[0] * x * y * (xx - yy);
    b[17] = -C4[1] * y * z * (3.0 * xx - yy);
    b[18] = C4[2] * x * y * (7.0 * zz - 1.0);
    b[19] = -C4[3] * y * z * (7.0 * zz - 3.0);
    b[20] = C4[4] * (zz * (35.0 * zz - 30.0) + 3.0);
    b[21] = -C4[3] * x * z * (7.0 * zz - 3.0);
    b[22] = C4[5] * (xx - yy) * (7.0 * zz - 1.0);
    b[23] = -C4[1] * x * z * (xx - 3.0 * yy);
    b[24] = C44 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy));
    b
}

/// Returns the derivatives of [`basis`].
pub fn derivatives(degree: usize, [x, y, z]: [f32; 3]) -> [[f32; 3]; 25] {
    let mut d = [[0.0; 3]; 25];
    if degree == 0 {
        return d;
    }
    (d[1][1], d[2][2], d[3][0]) = (-C1, C1, -C1);
    if degree == 1 {
        return d;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    d[4] = [C2[0] * y, C2[0] * x, 0.0];
    d[5] = [0.0, -C2[0] * z, -C2[0] * y];
    d[6] = [-2.0 * C2[1] * x, -2.0 * C2[1] * y, 4.0 * C2[1] * z];
    d[7] = [-C2[0] * z, 0.0, -C2[0] * x];
    d[8] = [2.0 * C2[2] * x, -2.0 * C2[2] * y, 0.0];
    if degree == 2 {
        return d;
    }
    let four = 4.0 * zz - xx - yy;
    d[9] = [-6.0 * C3[0] * x * y, -3.0 * C3[0] * (xx - yy), 0.0];
    d[10] = [C3[1] * y * z, C3[1] * x * z, C3[1] * x * y];
    d[11] = [2.0 * C3[2] * x * y, -C3[2] * (four - 2.0 * yy), -8.0 * C3[2] * y * z];
    d[12] = [-6.0 * C3[3] * x * z, -6.0 * C3[3] * y * z, 3.0 * C3[3] * (2.0 * zz - xx - yy)];
    d[13] = [-C3[2] * (four - 2.0 * xx), 2.0 * C3[2] * x * y, -8.0 * C3[2] * x * z];
    d[14] = [2.0 * C3[4] * x * z, -2.0 * C3[4] * y * z, C3[4] * (xx - yy)];
    d[15] = [-3.0 * C3[0] * (xx - yy), 6.0 * C3[0] * x * y, 0.0];
    if degree == 3 {
        return d;
    }
    let (one, three) = (7.0 * zz - 1.0, 7.0 * zz - 3.0);
    d[16] = [C4[0] * y * (3.0 * xx - yy), C4[0] * x * (xx - 3.0 * yy), 0.0];
    d[17] = [-6.0 * C4[1] * x * y * z, -3.0 * C4[1] * z * (xx - yy), -C4[1] * y * (3.0 * xx - yy)];
    d[18] = [C4[2] * y * one, C4[2] * x * one, 14.0 * C4[2] * x * y * z];
    d[19] = [0.0, -C4[3] * z * three, -C4[3] * y * (21.0 * zz - 3.0)];
    d[20] = [0.0, 0.0, C4[4] * z * (140.0 * zz - 60.0)];
    d[21] = [-C4[3] * z * three, 0.0, -C4[3] * x * (21.0 * zz - 3.0)];
    d[22] = [2.0 * C4[5] * x * one, -2.0 * C4[5] * y * one, 14.0 * C4[5] * z * (xx - yy)];
    d[23] = [-3.0 * C4[1] * z * (xx - yy), 6.0 * C4[1] * x * y * z, -C4[1] * x * (xx - 3.0 * yy)];
    d[24] = [4.0 * C44 * x * (xx - 3.0 * yy), 4.0 * C44 * y * (yy - 3.0 * xx), 0.0];
    d
}
