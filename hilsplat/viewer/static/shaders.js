// Shaders equivalent to `hilsplat.splat.rasterise.api.render`: EWA projection with the ray clamped to
// 30 % beyond the image, 0.3 px^2 added, alpha below 1/255 dropped and cut at 0.999, colour max(0, 0.5 + SH).

import { MARKED, MARKED_SHARE } from "./styles.js";

export const vertex = (bases, texels) => `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
#define BASES ${bases}
#define TEXELS ${texels}
uniform usampler2D geometry, rest, nodes, marks;
uniform sampler2D style, ramp;
uniform mat3 rotation;
uniform vec3 translation, centre;
uniform vec4 lens, limits;
uniform vec2 size;
uniform ivec3 use;
uniform int mode, ramped;
in vec2 corner;
in uint index;
out vec2 place;
flat out vec4 paint;
flat out uint number;

ivec2 at(uint texel) { return ivec2(int(texel & 4095u), int(texel >> 12)); }

// Positions, rotations and harmonics are in the axes of SPZ: y up, z backwards.
uint words[4 * TEXELS];
float byte_at(int k) { return float((words[k >> 2] >> uint(8 * (k & 3))) & 255u); }
vec3 bytes_at(int k) { return vec3(byte_at(k), byte_at(k + 1), byte_at(k + 2)); }

vec3 harmonic(vec3 d) {
  #define SH(k) ((bytes_at(3 * k + 3) - 128.0) / 128.0)
  vec3 rgb = 0.5 + 0.28209479177387814 * (bytes_at(0) / 255.0 - 0.5) / 0.15;
  float x = d.x, y = d.y, z = d.z;
  #if BASES > 1
  rgb += 0.4886025119029199 * (-y * SH(1) + z * SH(2) - x * SH(3));
  #endif
  #if BASES > 4
  float xx = x*x, yy = y*y, zz = z*z;
  rgb += 1.0925484305920792 * (x*y * SH(4) - y*z * SH(5) - x*z * SH(7))
       + 0.31539156525252005 * (2.0*zz - xx - yy) * SH(6) + 0.5462742152960396 * (xx - yy) * SH(8);
  #endif
  #if BASES > 9
  rgb += -0.5900435899266435 * (y*(3.0*xx - yy) * SH(9) + x*(xx - 3.0*yy) * SH(15)) + 2.890611442640554 * x*y*z * SH(10)
       - 0.4570457994644658 * (4.0*zz - xx - yy) * (y * SH(11) + x * SH(13))
       + 0.3731763325901154 * z*(2.0*zz - 3.0*xx - 3.0*yy) * SH(12) + 1.445305721320277 * z*(xx - yy) * SH(14);
  #endif
  return max(rgb, 0.0);
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);   // outside the view unless found visible
  place = vec2(0.0); paint = vec4(0.0); number = index + 1u;
  uvec4 first = texelFetch(geometry, at(index), 0);
  float opacity = float(first.w & 255u) / 255.0;
  uvec4 own = texelFetch(nodes, at(index), 0);

  vec4 chosen = vec4(0.0);
  if (ramped == 1) chosen = vec4(texelFetch(ramp, ivec2(int(own.w), 0), 0).rgb, 0.8);
  else for (int level = 0; level < 3; level++) if (use[level] == 1) {
    vec4 found = texelFetch(style, at(own[level]), 0);
    if (found.a > 0.0) chosen = found;
  }
  uint mark = texelFetch(marks, at(index), 0).r;
  if (mark == 2u) return;
  if (mark == 1u) chosen = vec4(${MARKED.map((value) => (value / 255).toFixed(6))}, ${MARKED_SHARE.toFixed(6)});
  bool other = chosen.a == 0.0;
  if (other && mode == 3) return;
  if (other && mode == 2) opacity *= 0.08;
  if (opacity < 1.0 / 255.0) return;

  vec3 mean = uintBitsToFloat(first.xyz), p = rotation * mean + translation;
  if (p.z <= 0.01) return;
  vec3 scale = exp(vec3((first.www >> uvec3(8u, 16u, 24u)) & 255u) / 16.0 - 10.0);
  for (int t = 0; t < TEXELS; t++) {
    uvec4 found = texelFetch(rest, at(index * uint(TEXELS) + uint(t)), 0);
    for (int k = 0; k < 4; k++) words[4 * t + k] = found[k];
  }
  vec3 turning = bytes_at(3) / 127.5 - 1.0;
  vec4 q = normalize(vec4(sqrt(max(0.0, 1.0 - dot(turning, turning))), turning));
  float w = q.x, i = q.y, j = q.z, k = q.w;
  mat3 turn = mat3(1.0 - 2.0*(j*j + k*k), 2.0*(i*j + w*k), 2.0*(i*k - w*j),
                   2.0*(i*j - w*k), 1.0 - 2.0*(i*i + k*k), 2.0*(j*k + w*i),
                   2.0*(i*k + w*j), 2.0*(j*k - w*i), 1.0 - 2.0*(i*i + j*j));
  mat3 axes = rotation * turn;
  vec2 ray = clamp(p.xy / p.z, limits.xz, limits.yw), f = lens.xy / p.z;
  float xx = 0.3, xy = 0.0, yy = 0.3;
  for (int a = 0; a < 3; a++) {
    vec3 axis = axes[a] * scale[a];
    vec2 uv = f * (axis.xy - ray * axis.z);
    xx += uv.x * uv.x; xy += uv.x * uv.y; yy += uv.y * uv.y;
  }
  if (!(xx * yy - xy * xy > 0.0)) return;
  vec2 middle = lens.xy * p.xy / p.z + lens.zw;
  float reach = sqrt(2.0 * log(255.0 * opacity));
  vec2 half_size = reach * sqrt(vec2(xx, yy));
  if (any(lessThan(middle + half_size, vec2(0.0))) || any(greaterThan(middle - half_size, size))) return;
  // the quad is aligned with the axes of the ellipse; place is in standard deviations
  float mid = 0.5 * (xx + yy), apart = length(vec2(0.5 * (xx - yy), xy));
  float wide = mid + apart, narrow = max(mid - apart, 1e-4);
  vec2 along = apart < 1e-7 * mid ? vec2(1.0, 0.0) : normalize(abs(wide - xx) > abs(wide - yy) ? vec2(xy, wide - xx) : vec2(wide - yy, xy));
  place = reach * corner;
  vec2 px = middle + place.x * sqrt(wide) * along + place.y * sqrt(narrow) * vec2(-along.y, along.x);
  gl_Position = vec4(2.0 * px.x / size.x - 1.0, 1.0 - 2.0 * px.y / size.y, 0.0, 1.0);

  vec3 rgb = harmonic(normalize(mean - centre));
  if (other && mode == 1) rgb = vec3(0.35 * dot(rgb, vec3(0.299, 0.587, 0.114)));
  paint = vec4(mix(rgb, chosen.rgb, chosen.a), opacity);
}`;

export const fragment = `#version 300 es
precision highp float; precision highp int;
in vec2 place;
flat in vec4 paint;
flat in uint number;
uniform int numbering;
out vec4 colour;
void main() {
  float alpha = min(paint.a * exp(-0.5 * dot(place, place)), 0.999);
  if (numbering == 1) {   // the last one written is the nearest that is opaque enough
    if (alpha < 0.12) discard;
    colour = vec4(float(number & 255u), float((number >> 8) & 255u), float((number >> 16) & 255u), 255.0) / 255.0;
    return;
  }
  if (alpha < 1.0 / 255.0) discard;
  colour = vec4(paint.rgb * alpha, alpha);
}`;
