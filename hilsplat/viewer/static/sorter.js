// Sort Gaussians from back to front: two passes of a radix sort over the upper 24 bits of their depths.

const NEAR = 0.01;
let means = null, keys, rows, other, otherKeys, here = 0;

onmessage = ({ data }) => {
  if (data.count !== undefined) {
    means = new Float32Array(3 * data.count);
    [keys, rows, other, otherKeys] = [0, 0, 0, 0].map(() => new Uint32Array(data.count));
    return;
  }
  if (data.means) {
    means.set(data.means, 3 * data.first);
    here = data.first + data.means.length / 3;
    return;
  }
  const [a, b, c, d] = data.row, n = here;
  const depth = new Float32Array(1), bits = new Uint32Array(depth.buffer);
  const low = new Uint32Array(4097), high = new Uint32Array(4097);
  let count = 0;
  for (let i = 0; i < n; i++) {
    const z = a * means[3 * i] + b * means[3 * i + 1] + c * means[3 * i + 2] + d;
    if (z <= NEAR) continue;
    depth[0] = z;
    const key = bits[0] >>> 7;   // positive floats order like integers; the sign is 0
    keys[count] = key; rows[count] = i; count++;
    low[(key & 4095) + 1]++; high[(key >>> 12) + 1]++;
  }
  for (let k = 0; k < 4096; k++) { low[k + 1] += low[k]; high[k + 1] += high[k]; }
  for (let e = 0; e < count; e++) { const at = low[keys[e] & 4095]++; other[at] = rows[e]; otherKeys[at] = keys[e]; }
  const order = data.order && data.order.length >= count ? data.order : new Uint32Array(means.length / 3);
  for (let e = 0; e < count; e++) order[count - 1 - high[otherKeys[e] >>> 12]++] = other[e];
  postMessage({ order, count }, [order.buffer]);
};
