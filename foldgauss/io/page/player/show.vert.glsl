#version 300 es
// A rectangle of the screen that shows a part of an image: (left, top, width, height), as fractions of each.
precision highp float;

uniform vec4 onScreen, inPicture, inTarget;

out vec2 atPicture, atTarget;

void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  atPicture = inPicture.xy + corner * inPicture.zw;
  atTarget = inTarget.xy + corner * inTarget.zw;
  vec2 place = onScreen.xy + corner * onScreen.zw;
  gl_Position = vec4(2.0 * place.x - 1.0, 1.0 - 2.0 * place.y, 0.0, 1.0);
}
