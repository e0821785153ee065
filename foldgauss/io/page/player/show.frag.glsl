#version 300 es
// The rendered model over the background, the original, or their difference.
precision highp float;

uniform sampler2D rendered, original;
uniform int what; // 0 the model, 1 the original, 2 the difference
uniform vec3 background;
uniform float gain;

in vec2 atPicture, atTarget;
out vec4 result;

void main() {
  vec4 model = texture(rendered, atTarget); // color and transmittance
  vec3 color = clamp(model.rgb + model.a * background, 0.0, 1.0);
  vec3 other = texture(original, atPicture).rgb;
  if (what == 1) color = other;
  if (what == 2) color = min(gain * abs(color - other), 1.0);
  result = vec4(color, 1.0);
}
