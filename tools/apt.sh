# Sourced by the installers. install_packages PURPOSE PACKAGE...: Debian packages, where permitted; never fails.
install_packages() {
  local purpose="$1" become=""
  shift
  [ "$(uname -s)" = Linux ] || return 0
  command -v apt-get >/dev/null || return 0
  if [ "$(id -u)" != 0 ]; then
    command -v sudo >/dev/null && sudo -n true 2>/dev/null || return 0
    become="sudo -n"
  fi
  echo "installing $* (for $purpose)" >&2
  export DEBIAN_FRONTEND=noninteractive
  { $become apt-get install -y -qq --no-install-recommends "$@" ||
    { $become apt-get update -qq && $become apt-get install -y -qq --no-install-recommends "$@"; }; } \
    </dev/null >/dev/null 2>&1 || true
}
