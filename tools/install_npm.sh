#!/usr/bin/env bash
# Installs Debian's npm (and Node), for the libraries of docs/play and its tests, where it may; never fails.
command -v npm >/dev/null && exit 0
[ "$(uname -s)" = Linux ] || exit 0
become=""
if [ "$(id -u)" != 0 ]; then
  if command -v sudo >/dev/null && sudo -n true 2>/dev/null; then become="sudo -n"; else become=none; fi
fi
if command -v apt-get >/dev/null && [ "$become" != none ]; then
  echo "installing npm (for the page play/ of the documentation)" >&2
  export DEBIAN_FRONTEND=noninteractive
  { $become apt-get install -y -qq --no-install-recommends npm ||
    { $become apt-get update -qq && $become apt-get install -y -qq --no-install-recommends npm; }; } \
    </dev/null >/dev/null 2>&1
fi
command -v npm >/dev/null || echo "no npm: the page play/ of the documentation is left without its libraries" >&2
exit 0
