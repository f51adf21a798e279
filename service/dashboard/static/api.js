// GET requests to the API of this origin: JSON with ETags, and bytes.

const TIMEOUT_MS = 10_000;
const KEY = "asim-key";
const answers = new Map(); // url -> {etag, body}

/** The service did not answer, or answered 5xx or 429: worth asking again later. */
export class Unreachable extends Error {}

/** The service refuses this request (4xx); `status` is the HTTP status, the message its problem detail. */
export class Refused extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

/** The key goes with every request from now on, until the tab is closed. */
export function useKey(key) {
  sessionStorage.setItem(KEY, key);
  answers.clear();
}

/** JSON at `path`, relative to the page's folder. Repeats the last body when the service answers 304. */
export async function get(path, params, signal) {
  const url = addressOf(path, params);
  const known = answers.get(url.href);
  const headers = { Accept: "application/json" };
  if (known) headers["If-None-Match"] = known.etag;
  const response = await ask(url, headers, signal);
  if (response.status === 304 && known) return known.body;
  const body = await bodyOf(response);
  const etag = response.headers.get("ETag");
  if (etag) answers.set(url.href, { etag, body });
  return body;
}

/** The body at `path` as an ArrayBuffer. */
export async function bytes(path, params, signal) {
  const response = await ask(addressOf(path, params), {}, signal);
  return response.ok ? response.arrayBuffer() : bodyOf(response);
}

/** The items of all pages of a listing, at most `pages` of them. */
export async function list(path, params, signal, pages = 10) {
  const items = [];
  let cursor = null;
  for (let page = 0; page < pages; page += 1) {
    const answer = await get(path, { limit: 1000, ...params, cursor }, signal);
    items.push(...answer.items);
    cursor = answer.next;
    if (!cursor) break;
  }
  return items;
}

function addressOf(path, params) {
  const url = new URL(path, document.baseURI);
  for (const [name, value] of Object.entries(params ?? {})) if (value != null) url.searchParams.set(name, value);
  return url;
}

async function ask(url, headers, signal) {
  const key = sessionStorage.getItem(KEY);
  if (key) headers.Authorization = `Bearer ${key}`;
  try {
    // no-store: the browser's own cache stays out of it, so a 304 arrives here as a 304
    return await fetch(url, { headers, cache: "no-store", signal: AbortSignal.any([signal, AbortSignal.timeout(TIMEOUT_MS)]) });
  } catch (error) {
    if (signal.aborted) throw error;
    throw new Unreachable("Service not reachable");
  }
}

async function bodyOf(response) {
  let body;
  try {
    body = await response.json();
  } catch {
    throw new Unreachable(`Service answered ${response.status} without JSON`);
  }
  if (response.ok) return body;
  const detail = String(body.detail ?? body.title ?? "no detail");
  if (response.status >= 500 || response.status === 429) throw new Unreachable(`Service answered ${response.status}: ${detail}`);
  throw new Refused(response.status, detail);
}
