#version 300 es
// One folded Gaussian, conditioned on the time, as a rectangle of pixels: FoldedSplats.at and the engine's projection.
precision highp float;
precision highp int;
precision highp sampler2D;

uniform sampler2D gaussians; // `texels` of each, see gaussians.js
uniform sampler2D maps; // of each shared path at this time: two texels, the rows (L | b)
uniform int texels, degree;
uniform float time, envelopePower, envelopeFloor;
uniform float unit; // pixels of the target per unit of model space
uniform vec2 origin, target; // the frame's center and the target's size, pixels
uniform float lowPass, cutoff, support; // px^2; alpha; squared deviations
uniform float highlight; // of selected Gaussians: how much of their color is the tint's

in uint instance; // index; highest bit: selected

flat out vec2 center;
flat out vec4 axes; // rows that map an offset in pixels to standard deviations
flat out vec4 paint; // color and opacity
flat out float tinted;

vec4 texel(int index, int k) {
  int at = index * texels + k;
  return texelFetch(gaussians, ivec2(at & 2047, at >> 11), 0);
}

vec2 path(int index, float u) {
  vec2 sum = vec2(0.0);
  for (int pair = (degree - 1) / 2; pair >= 0 && degree > 0; pair--) { // Horner; what is beyond the degree is 0
    vec4 two = texel(index, 3 + pair);
    sum = u * (two.zw + sum);
    sum = u * (two.xy + sum);
  }
  return sum;
}

vec3 row(int path, int k) {
  int at = 2 * (path - 1) + k;
  return texelFetch(maps, ivec2(at & 2047, at >> 11), 0).xyz;
}

void main() {
  int index = int(instance & 0x7fffffffu);
  vec4 place = texel(index, 0), shape = texel(index, 1);
  paint = texel(index, 2);
  tinted = (instance >> 31) == 1u ? highlight : 0.0;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside: not rendered
  if (!(paint.a >= cutoff)) return;

  vec4 last = texel(index, texels - 1); // number of its shared path, from 1, and the times at which it moves
  float u = place.z - clamp(time, last.y, last.z), tau = u / place.w;
  float shrink = sqrt(envelopeFloor + (1.0 - envelopeFloor) * exp(-0.5 * envelopePower * tau * tau));
  vec2 mean = place.xy + path(index, u), deviations = shape.xy * shrink, first = shape.zw;
  int moving = int(last.x);
  if (moving > 0) {
    vec3 top = row(moving, 0), bottom = row(moving, 1);
    mat2 linear = mat2(top.x, bottom.x, top.y, bottom.y);
    mean = linear * mean + vec2(top.z, bottom.z);
    // Columns of L R S, made orthogonal by a turn from the right: the longer one is an axis, and the area gives the other.
    vec2 one = linear * first * deviations.x, other = linear * vec2(-first.y, first.x) * deviations.y;
    float area = abs(determinant(linear)) * deviations.x * deviations.y;
    float apart = (dot(other, other) - dot(one, one)) * unit * unit, twice = 2.0 * dot(one, other) * unit * unit; // px^2
    float slope = (apart < 0.0 ? -twice : twice) / max(abs(apart) + sqrt(apart * apart + twice * twice), 1e-30);
    vec2 turned = one - slope * other, across = other + slope * one;
    vec2 longer = (dot(turned, turned) < dot(across, across) ? across : turned) * inversesqrt(1.0 + slope * slope);
    deviations.x = max(length(longer), 1e-30);
    deviations.y = area / deviations.x;
    first = longer / deviations.x;
  }
  vec2 variances = deviations * deviations * (unit * unit) + lowPass;
  if (!(min(variances.x, variances.y) > 1e-12)) return;

  // In the frame of its own axes the covariance is diagonal, and so is the low pass: nothing cancels.
  vec2 second = vec2(-first.y, first.x), roots = sqrt(variances);
  center = mean * unit + origin;
  axes = vec4(first / roots.x, second / roots.y);
  float reach = min(2.0 * log(paint.a / cutoff), support) * 1.001 + 0.001; // slightly too far: alpha decides in the fragment shader
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vec2 away = corner * sqrt(reach) * roots;
  gl_Position = vec4(2.0 * (center + away.x * first + away.y * second) / target - 1.0, 0.0, 1.0);
}
