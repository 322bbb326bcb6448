#!/bin/sh
# Copies the models of the bucket $BUCKET into the folder $1, again every $INTERVAL seconds.
#
# The service ignores a version without manifest.json. So the manifests come after the other files,
# and the aliases come last. The aliases and the list of manifests are read first, so a version that
# is published meanwhile waits for the next round. rclone writes each file under a temporary name
# and renames it. Published versions never change, so existing files are not compared.
set -u
cd "$1" || exit

copy() {
  # Without the file, rclone prints nothing and succeeds.
  rclone cat "$BUCKET/aliases.json" >.aliases && [ -s .aliases ] &&
    rclone lsf --recursive --files-only --include '/*/*/manifest.json' "$BUCKET" >.manifests &&
    rclone copy --ignore-existing --include '/*/*/{model.safetensors,card.md}' "$BUCKET" . &&
    rclone copy --ignore-existing --files-from .manifests "$BUCKET" . &&
    { cmp -s .aliases aliases.json || mv .aliases aliases.json; }
}

trap exit TERM
# An earlier container may have left temporary files.
find . -name '*.partial' -delete
while true; do
  copy || echo "the copy of $BUCKET is incomplete" >&2
  sleep "$INTERVAL" &
  wait $!
done
