// Asks each question with types that openapi-typescript generates. The test compiles this file.
import type { paths } from "./generated";

type Question = "/relations" | "/missing" | "/outliers" | "/rooms" | "/generate" | "/where";
type Body<Route extends Question> =
  paths[Route]["post"]["requestBody"]["content"]["application/json"];
type Answer<Route extends Question> =
  paths[Route]["post"]["responses"][200]["content"]["application/json"];
type Problem =
  paths["/missing"]["post"]["responses"][422]["content"]["application/problem+json"];

async function ask<Route extends Question>(
  route: Route,
  body: Body<Route>,
): Promise<Answer<Route>> {
  const response = await fetch(`http://127.0.0.1:8000${route}`, {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: JSON.stringify(body),
  });
  if (!response.ok) {
    const problem: Problem = await response.json();
    throw new Error(`${problem.type}: ${problem.errors?.[0]?.message ?? problem.detail}`);
  }
  return response.json();
}

export async function askEach(): Promise<(string | number | undefined)[]> {
  const objects: Body<"/missing">["objects"] = [
    "bed",
    { id: "lamp_1", label: "lamp", position: { x: 1, y: 0, z: 0.5 }, confidence: 0.9 },
    { label: "desk", position: [2, 0, 0.4] },
  ];
  const { relations } = await ask("/relations", { objects, pairs: [["lamp_1", "desk"]] });
  const { missing } = await ask("/missing", { objects, at: ["on-top", "bed"], up: "z" });
  const { outliers } = await ask("/outliers", { objects, relations: [["lamp_1", "left", "bed"]] });
  const { room_types } = await ask("/rooms", { objects, units: "cm" });
  const { scenes } = await ask("/generate", { room_type: "bedroom", count: 2 });
  const { places } = await ask("/where", { label: "lamp", rooms: [{ id: "bedroom", objects }] });
  return [
    relations[0]?.probability,
    missing[0]?.placements?.[0]?.relation,
    outliers[0]?.because?.[0]?.log_odds_change,
    room_types?.[0]?.room_type,
    scenes[0]?.objects[0],
    places[0]?.room,
  ];
}

export async function mistakes(): Promise<void> {
  // @ts-expect-error: a required field is missing
  await ask("/missing", {});
  // @ts-expect-error: an unknown field
  await ask("/missing", { objects: ["bed"], object: "bed" });
  // @ts-expect-error: an unknown unit
  await ask("/rooms", { objects: ["bed"], units: "miles" });
  // @ts-expect-error: the answer has no such field
  (await ask("/missing", { objects: ["bed"] })).outliers;
}
