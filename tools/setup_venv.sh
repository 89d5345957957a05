#!/usr/bin/env bash
# usage: tools/setup_venv.sh VENV     creates VENV with everything that `make` needs.
#
# PYTHON        the interpreter to use (default: the first of python3.11, 3.12, 3.13, python3 that runs)
# TORCH_INDEX   where torch comes from. Unset, on Linux without an NVIDIA device, PyTorch's own CPU index is
#               taken when it can be reached, because the default wheel brings gigabytes of CUDA along.
set -euo pipefail
venv=${1:?usage: tools/setup_venv.sh VENV}
here=$(cd "$(dirname "$0")/.." && pwd)
cpu_index=https://download.pytorch.org/whl/cpu

pick_python() {
    for python in ${PYTHON:-python3.11 python3.12 python3.13 python3}; do
        if "$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null; then
            echo "$python"; return
        fi
    done
    echo "setup: no Python from 3.11 to 3.13 found; install one, or set PYTHON=/path/to/python3.11" >&2
    exit 1
}

reachable() {
    "$venv/bin/python" - "$1" <<'PY' 2>/dev/null
import sys, urllib.request
urllib.request.urlopen(sys.argv[1] + "/torch/", timeout=5).close()
PY
}

python=$(pick_python)
echo "setup: creating $venv with $("$python" --version)"
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
pip=("$venv/bin/python" -m pip --disable-pip-version-check)

torch_pin=$(grep -E '^torch==' "$here/constraints.txt")
index=${TORCH_INDEX:-}
if [ -z "$index" ] && [ "$(uname -s)" = Linux ] && [ ! -e /dev/nvidia0 ] && reachable "$cpu_index"; then
    index=$cpu_index
fi
echo "setup: installing $torch_pin ${index:+from $index}"
"${pip[@]}" install -q ${index:+--extra-index-url "$index"} -c "$here/constraints.txt" \
    "${torch_pin}${index:+$([ "$index" = "$cpu_index" ] && echo +cpu)}"
echo "setup: installing the rest (a minute or two)"
"${pip[@]}" install -q -c "$here/constraints.txt" -e "$here[generate,completion,gl,remote,docs,dev]"
"$venv/bin/python" -c 'import ocnf_data; print("setup: ocnf", ocnf_data.__version__, "is ready")'
