// Questions to the server of the page; what it refuses comes back as its own sentence.

export class Refused extends Error {
  constructor(message, status) { super(message); this.status = status; }
}

async function checked(response) {
  if (response.ok) return response;
  let message = `${response.status} ${response.statusText}`;
  try { message = (await response.clone().json()).error; } catch { message = await response.text() || message; }
  throw new Refused(message, response.status);
}

export const get = async (path) => checked(await fetch(path));
export const send = async (path, value, { method = "POST", headers = {}, signal } = {}) => checked(await fetch(path, {
  method, signal, headers: { "content-type": "application/json", ...headers }, body: JSON.stringify(value),
}));
