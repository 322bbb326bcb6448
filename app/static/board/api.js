/** HTTP calls of the service: they return answers or throw errors. */

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
  // The browser may forbid storage. The key is then kept until the page is closed.
}

export const hasKey = () => Boolean(key);

/** Stores the API key of the service until the tab is closed. */
export function useKey(text) {
  key = text || null;
  try {
    sessionStorage.setItem(KEY, key ?? '');
  } catch {
    // See above.
  }
}

/** URL of the service. The page is at its root, perhaps below the path prefix of a proxy. */
export const service = new URL('.', document.baseURI).href.replace(/\/$/, '');

/**
 * @param {string} path for example "models/default/vocabulary"
 * @param {object} [body] body of a POST request; without it, a GET request is sent
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
