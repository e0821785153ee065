// CIELAB of sRGB, D65, and the distance of two colors: 1 is just noticeable, 10 a shade, 30 another color.

const WHITE = [0.95047, 1, 1.08883];
const TO_XYZ = [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]];

const linear = (own) => (own > 0.04045 ? ((own + 0.055) / 1.055) ** 2.4 : own / 12.92);
const curve = (own) => (own > 0.008856 ? Math.cbrt(own) : 7.787 * own + 16 / 116);

export function toLab(color) {
  const [r, g, b] = color.map((own) => linear(Math.min(Math.max(own, 0), 1)));
  const [x, y, z] = TO_XYZ.map((row, k) => curve((row[0] * r + row[1] * g + row[2] * b) / WHITE[k]));
  return [116 * y - 16, 500 * (x - y), 200 * (y - z)];
}

export const deltaE = (one, other) => Math.hypot(one[0] - other[0], one[1] - other[1], one[2] - other[2]);
