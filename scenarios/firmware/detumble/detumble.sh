#!/bin/sh
# Builds the firmware's source as a program for the machine that flies it, whatever its processor, and becomes the program.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${CC:-cc}" -std=gnu99 -O2 -Wall -I"$here" -I"$here/../../flight" -o "$folder/detumble" \
    "$here/detumble.c" "$here/control.c" "$here/computer.c"
if [ -e /proc/self/fd ]; then
    # An open file needs no name: nothing is left behind, however the program ends.
    exec 3<"$folder/detumble"
    rm -rf "$folder"
    trap - EXIT
    exec /proc/self/fd/3
fi
"$folder/detumble"
