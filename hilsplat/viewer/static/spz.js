// Read Gaussians in SPZ version 2. Columns become texels, which the shader reads and unpacks.

export async function unzipped(buffer) {
  return new Response(new Blob([buffer]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

// One texel contains position, opacity and log scales; `texels` more contain colour, rotation and harmonics, a byte each.
export async function readChunk(buffer) {
  const bytes = new Uint8Array(await unzipped(buffer)), head = new DataView(bytes.buffer);
  const count = head.getUint32(8, true), degree = bytes[12], unit = 2 ** -bytes[13], others = 3 * ((degree + 1) ** 2 - 1);
  const texels = Math.ceil((6 + others) / 16), geometry = new ArrayBuffer(16 * count), places = new Float32Array(geometry), rest = new Uint8Array(16 * texels * count);
  let at = 16;
  for (let i = 0; i < count; i++) for (let axis = 0; axis < 3; axis++, at += 3)
    places[4 * i + axis] = unit * (bytes[at] + 256 * bytes[at + 1] + 65536 * (bytes[at + 2] << 24 >> 24));
  const column = (target, stride, first, width) => {
    for (let i = 0; i < count; i++) for (let k = 0; k < width; k++) target[stride * i + first + k] = bytes[at++];
  };
  const small = new Uint8Array(geometry);
  column(small, 16, 12, 1);             // opacity
  column(rest, 16 * texels, 0, 3);      // colour
  column(small, 16, 13, 3);             // scales
  column(rest, 16 * texels, 3, 3);      // rotation
  column(rest, 16 * texels, 6, others); // harmonics
  return { count, bases: (degree + 1) ** 2, texels, geometry: new Uint32Array(geometry), rest: new Uint32Array(rest.buffer), places };
}
