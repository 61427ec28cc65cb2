// Requests to the page's server; a refused request throws the server's message.

export class Refused extends Error {
  constructor(message, status) { super(message); this.status = status; }
}

// A server that doesn't answer, or stops answering, refuses with status 0.
const lost = (error) => { throw error.name === "AbortError" ? error : new Refused("The server has stopped.", 0); };

async function checked(path, options) {
  const response = await fetch(path, options).catch(lost);
  if (response.ok) return response;
  let message = `${response.status} ${response.statusText}`;
  try { message = (await response.clone().json()).error; } catch { message = await response.text() || message; }
  throw new Refused(message, response.status);
}

export const get = (path) => checked(path);
export const send = (path, value, { method = "POST", headers = {}, signal } = {}) => checked(path, {
  method, signal, headers: { "content-type": "application/json", ...headers }, body: JSON.stringify(value),
});

// Read progress lines {"made", "of"}, then {"bytes"} and the file of that many bytes; or {"error"}.
export async function streamed(response, told) {
  const reader = response.body.getReader(), decoder = new TextDecoder(), parts = [];
  let head = new Uint8Array(0), wanted = -1, got = 0;
  for (;;) {
    const { value, done } = await reader.read().catch(lost);
    if (done) break;
    if (wanted < 0) {
      const both = new Uint8Array(head.length + value.length);
      both.set(head); both.set(value, head.length);
      head = both;
      for (let end; wanted < 0 && (end = head.indexOf(10)) >= 0; head = head.subarray(end + 1)) {
        const said = JSON.parse(decoder.decode(head.subarray(0, end)));
        if ("error" in said) throw new Refused(said.error, 409);
        if ("bytes" in said) wanted = said.bytes; else told(said.made, said.of);
      }
      if (wanted < 0) continue;
      parts.push(head); got = head.length;
    } else { parts.push(value); got += value.length; }
  }
  if (got !== wanted) throw new Refused("The file is incomplete: the server has stopped.", 0);
  return new Blob(parts);
}
