#!/usr/bin/env bash
# Installs Debian's Chromium for the browser tests of the viewer and of docs/play, where permitted; never fails.
. "$(dirname "$0")/apt.sh"
has_chromium() {
  [ -n "$MQE_CHROMIUM" ] || command -v chromium chromium-browser google-chrome >/dev/null
}

has_chromium && exit 0
install_packages "the browser tests" chromium
has_chromium || echo "no chromium: the browser tests are skipped" >&2
exit 0
