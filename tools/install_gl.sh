#!/usr/bin/env bash
# Installs the GL libraries for offscreen rendering, where permitted; never fails.
packages="libegl1 libgl1-mesa-dri"

has_gl() {
  # Mesa without its drivers loads but cannot render, so both are checked.
  ldconfig -p 2>/dev/null | grep -q 'libEGL\.so\.1' || return 1
  ldconfig -p 2>/dev/null | grep -qE 'libEGL_nvidia|libgallium' && return 0
  compgen -G '/usr/lib/*/dri/*_dri.so' >/dev/null || compgen -G '/usr/lib*/dri/*_dri.so' >/dev/null
}

has_gl && exit 0
[ "$(uname -s)" = Linux ] || exit 0
become=""
if [ "$(id -u)" != 0 ]; then
  if command -v sudo >/dev/null && sudo -n true 2>/dev/null; then become="sudo -n"; else become=none; fi
fi
if command -v apt-get >/dev/null && [ "$become" != none ]; then
  echo "installing $packages (for offscreen rendering)" >&2
  export DEBIAN_FRONTEND=noninteractive
  { $become apt-get install -y -qq --no-install-recommends $packages ||
    { $become apt-get update -qq && $become apt-get install -y -qq --no-install-recommends $packages; }; } \
    </dev/null >/dev/null 2>&1
fi
has_gl || echo "no GL library: clips show a top view; for 3-D rendering install $packages" >&2
exit 0
