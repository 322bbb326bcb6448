#!/usr/bin/env bash
# Adapt the shipped model to a home with a bicycle in the bedroom: record, confirm, adapt and ask.
# Usage: examples/adapt.sh FOLDER
set -euo pipefail
folder=$(realpath -m "${1:?usage: $0 FOLDER}")
cd "$(dirname "${BASH_SOURCE[0]}")/.."
PATH=$PWD/.venv/bin:$PATH
mkdir -p "$folder"
cp -r model_store "$folder/store"

# Record. The model reports the bicycle. A robot uses Client(record="scenes.jsonl") all day.
for objects in "bed pillow lamp bicycle" "bed nightstand curtain bicycle" "bed dresser mirror bicycle"; do
    # shellcheck disable=SC2086  # every word is an object
    scene outliers $objects --room-type bedroom --offline "$folder/store" --record "$folder/scenes.jsonl"
done

# Confirm. A person does this on the web page; here, all scenes are right.
sed 's/^{/{"confirmed": true, /' "$folder/scenes.jsonl" >"$folder/confirmed.jsonl"

# Adapt, and serve the result as default. From 20 scenes on, the weights change too.
python -m training adapt default "$folder/scenes.jsonl" "$folder/confirmed.jsonl" \
    --name home --store "$folder/store" --promote

# Ask again. The service answers the same with: SCENE_STORE=FOLDER/store python -m app
scene outliers bed pillow lamp bicycle --room-type bedroom --offline "$folder/store"
