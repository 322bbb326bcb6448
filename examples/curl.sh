#!/usr/bin/env bash
# Ask the six questions by curl. SCENE_URL is the address of the service.
set -euo pipefail
url=${SCENE_URL:-http://127.0.0.1:8000}

ask() {  # ask ROUTE BODY: print the answer, or the problem and end with an error
    echo "$1"
    curl -sS --fail-with-body "$url/$1" -H 'content-type: application/json' -d "$2"
    echo
}

# How do a desk and a lamp stand to each other?
ask relations '{"objects": ["desk", "lamp"], "top_k": 2}'

# What is probably on the nightstand?
ask missing '{"objects": ["bed", "nightstand"], "at": ["on-top", "nightstand"], "top_k": 3, "detail": "scores"}'

# What does not belong into this bedroom?
ask outliers '{"objects": ["bed", "pillow", "nightstand", "lamp", "toilet"], "detail": "scores"}'

# Which room is this?
ask rooms '{"objects": ["bathtub", "sink", "towel"], "top_k": 1, "detail": "scores"}'

# What would a whole bedroom with a desk look like? The same seed gives the same scene.
ask generate '{"objects": ["desk"], "room_type": "bedroom", "seed": 7}'

# In which room is the toothbrush, and where? The robot has looked at the sink.
ask where '{"label": "toothbrush", "rooms": [{"id": "kitchen", "objects": ["fridge", "stove"]},
  {"id": "bathroom", "objects": ["toilet", "sink"]}], "searched": [{"room": "bathroom", "object": "sink"}]}'
