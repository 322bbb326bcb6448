/** The service over HTTP: answers, or errors that say what went wrong. */

/** A problem document of the service. */
export class ProblemError extends Error {
  constructor(problem, retryAfter) {
    super(problem.title);
    this.problem = problem;
    this.retryAfter = retryAfter;
  }
}

/** The service did not answer. */
export class UnreachableError extends Error {}

const KEY = 'scene-api-key';
let key = null;
try {
  key = sessionStorage.getItem(KEY);
} catch {
  // Storage may be forbidden; the key then lasts as long as the page.
}

export const hasKey = () => Boolean(key);

/** Remembers the service's API key until the tab is closed. */
export function useKey(text) {
  key = text || null;
  try {
    sessionStorage.setItem(KEY, key ?? '');
  } catch {
    // As above.
  }
}

/** Where the service is; the page lies at its root, perhaps behind a proxy's prefix. */
export const service = new URL('.', document.baseURI).href.replace(/\/$/, '');

/**
 * @param {string} path as in "models/default/vocabulary"
 * @param {object} [body] to post; without one the path is read
 * @param {AbortSignal} [signal]
 */
export async function call(path, body, signal) {
  const headers = { Accept: 'application/json' };
  if (key) headers['X-API-Key'] = key;
  if (body) headers['Content-Type'] = 'application/json';
  const options = body ? { method: 'POST', body: JSON.stringify(body) } : {};
  let response;
  let answer;
  try {
    response = await fetch(`${service}/${path}`, { ...options, headers, signal });
    answer = await response.json();
  } catch (error) {
    if (error.name === 'AbortError') throw error;
    throw new UnreachableError('The service does not answer.');
  }
  if (response.ok) return answer;
  throw new ProblemError(answer, Number(response.headers.get('Retry-After')) || null);
}
