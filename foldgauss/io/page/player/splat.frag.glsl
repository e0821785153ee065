#version 300 es
// A pixel of a Gaussian: alpha, limited as in the engines, and the color times alpha.
precision highp float;

uniform float cutoff, ceiling, support;
uniform vec3 tint;

flat in vec2 center;
flat in vec4 axes;
flat in vec4 paint;
flat in float tinted;
out vec4 result;

void main() {
  vec2 away = gl_FragCoord.xy - center;
  vec2 deviations = vec2(dot(axes.xy, away), dot(axes.zw, away));
  float square = dot(deviations, deviations);
  float alpha = paint.a * exp(-0.5 * square);
  if (!(alpha >= cutoff) || square > support) discard;
  alpha = min(alpha, ceiling);
  vec3 color = mix(paint.rgb, tint * (0.35 + 0.65 * dot(paint.rgb, vec3(0.3, 0.6, 0.1))), tinted);
  result = vec4(alpha * color, alpha);
}
