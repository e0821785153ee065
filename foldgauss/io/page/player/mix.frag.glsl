#version 300 es
// The weighted contribution of one rendered image to a fade: color and transmittance.
precision highp float;

uniform sampler2D rendered;
uniform float weight;

in vec2 atTarget;
out vec4 result;

void main() {
  result = weight * texture(rendered, atTarget);
}
