/** A request as a curl command and as Python code. */

import { hasKey, service } from './api.js';

const quoted = (text) => `'${text.replaceAll("'", `'\\''`)}'`;

/** A curl command for a shell. */
export function curl(question, body) {
  const lines = [`curl -sS ${quoted(`${service}/${question}`)}`, `-H 'Content-Type: application/json'`];
  if (hasKey()) lines.push('-H "X-API-Key: $SCENE_API_KEY"');
  lines.push(`-d ${quoted(JSON.stringify(body))}`);
  return lines.join(' \\\n  ');
}

/** A value as a Python literal. Python understands the escapes of JSON. */
function literal(value) {
  if (value === null) return 'None';
  if (typeof value === 'boolean') return value ? 'True' : 'False';
  if (Array.isArray(value)) return `[${value.map(literal).join(', ')}]`;
  if (typeof value === 'object') {
    const pairs = Object.entries(value).map(([name, own]) => `${JSON.stringify(name)}: ${literal(own)}`);
    return `{${pairs.join(', ')}}`;
  }
  return JSON.stringify(value);
}

/** Python code that uses the client of the service. */
export function python(question, { objects, label, rooms, ...fields }) {
  const things = (rooms ?? objects).map((thing) => `        ${literal(thing)},\n`).join('');
  const keywords = Object.entries(fields).map(([name, value]) => `        ${name}=${literal(value)},\n`);
  const key = hasKey() ? ', api_key=os.environ["SCENE_API_KEY"]' : '';
  return [
    ...(hasKey() ? ['import os', ''] : []),
    'from scene_client import Client',
    '',
    `with Client(${JSON.stringify(service)}${key}) as scene:`,
    `    answer = scene.${question}(`,
    ...(rooms ? [`        ${literal(label)},`] : []),
    `        [\n${things.replaceAll('        ', '            ')}        ],`,
    `${keywords.join('')}    )`,
    'print(answer.model_dump_json(indent=2))',
  ].join('\n');
}
