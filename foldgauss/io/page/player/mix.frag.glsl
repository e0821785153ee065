#version 300 es
// A drawn picture's share of a fade: what it adds to the others, colour and light left.
precision highp float;

uniform sampler2D drawn;
uniform float weight;

in vec2 atTarget;
out vec4 result;

void main() {
  result = weight * texture(drawn, atTarget);
}
