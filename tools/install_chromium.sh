#!/usr/bin/env bash
# Installs Debian's Chromium for the browser test of the viewer, where permitted; never fails.
has_chromium() {
  [ -n "$MQE_CHROMIUM" ] || command -v chromium chromium-browser google-chrome >/dev/null
}

has_chromium && exit 0
[ "$(uname -s)" = Linux ] || exit 0
become=""
if [ "$(id -u)" != 0 ]; then
  if command -v sudo >/dev/null && sudo -n true 2>/dev/null; then become="sudo -n"; else become=none; fi
fi
if command -v apt-get >/dev/null && [ "$become" != none ]; then
  echo "installing chromium (for the test of mqe view)" >&2
  export DEBIAN_FRONTEND=noninteractive
  { $become apt-get install -y -qq --no-install-recommends chromium ||
    { $become apt-get update -qq && $become apt-get install -y -qq --no-install-recommends chromium; }; } \
    </dev/null >/dev/null 2>&1
fi
has_chromium || echo "no chromium: the test of mqe view in a browser is skipped" >&2
exit 0
