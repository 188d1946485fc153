#!/usr/bin/env bash
# Installs the GL libraries for offscreen rendering, where permitted; never fails.
. "$(dirname "$0")/apt.sh"
packages="libegl1 libgl1-mesa-dri"

has_gl() {
  # Mesa without its drivers loads but cannot render, so both are checked.
  ldconfig -p 2>/dev/null | grep -q 'libEGL\.so\.1' || return 1
  ldconfig -p 2>/dev/null | grep -qE 'libEGL_nvidia|libgallium' && return 0
  compgen -G '/usr/lib/*/dri/*_dri.so' >/dev/null || compgen -G '/usr/lib*/dri/*_dri.so' >/dev/null
}

has_gl && exit 0
install_packages "offscreen rendering" $packages
has_gl || echo "no GL library: clips show a top view; for 3-D rendering install $packages" >&2
exit 0
