#!/usr/bin/env bash
# Installs Debian's npm (and Node) for the libraries of docs/play and its tests, where permitted; never fails.
. "$(dirname "$0")/apt.sh"
command -v npm >/dev/null && exit 0
install_packages "the page play/ of the documentation" npm
command -v npm >/dev/null || echo "no npm: the page play/ of the documentation is left without its libraries" >&2
exit 0
