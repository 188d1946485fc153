#!/usr/bin/env bash
# Installs Debian packages, where permitted; never fails. `bash tools/install.sh gl|chromium|npm`:
# GL libraries for offscreen rendering, Chromium for the browser tests, npm (and Node) for the page of `mqe play-site`.
case "$1" in
  gl) packages="libegl1 libgl1-mesa-dri" without="clips show a top view; for 3-D rendering install libegl1 libgl1-mesa-dri" ;;
  chromium) packages="chromium" without="the browser tests are skipped" ;;
  npm) packages="npm" without="the page play/ of the documentation is left without its libraries" ;;
  *) echo "usage: install.sh gl|chromium|npm" >&2; exit 2 ;;
esac

present() {
  case "$1" in
    gl) # Mesa without its drivers loads but cannot render, so both are checked.
      ldconfig -p 2>/dev/null | grep -q 'libEGL\.so\.1' || return 1
      ldconfig -p 2>/dev/null | grep -qE 'libEGL_nvidia|libgallium' && return 0
      compgen -G '/usr/lib/*/dri/*_dri.so' >/dev/null || compgen -G '/usr/lib*/dri/*_dri.so' >/dev/null ;;
    chromium) [ -n "$MQE_CHROMIUM" ] || command -v chromium chromium-browser google-chrome >/dev/null ;;
    npm) command -v npm >/dev/null ;;
  esac
}

install_packages() {
  local become=""
  [ "$(uname -s)" = Linux ] && command -v apt-get >/dev/null || return 0
  if [ "$(id -u)" != 0 ]; then
    command -v sudo >/dev/null && sudo -n true 2>/dev/null || return 0
    become="sudo -n"
  fi
  echo "installing $packages" >&2
  export DEBIAN_FRONTEND=noninteractive
  { $become apt-get install -y -qq --no-install-recommends $packages ||
    { $become apt-get update -qq && $become apt-get install -y -qq --no-install-recommends $packages; }; } \
    </dev/null >/dev/null 2>&1 || true
}

present "$1" || install_packages
present "$1" || echo "no $1: $without" >&2
exit 0
