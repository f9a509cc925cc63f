# Prints the first Python of a version that runs; a shim of pyenv is on PATH also where it does not.
# Usage: sh scripts/find_python.sh 3.12
for python in "python$1" ~/.pyenv/versions/"$1".*/bin/python /opt/*/bin/"python$1" /opt/*/Python/"$1".*/*/bin/python; do
  if "$python" -c "import sys; sys.exit('%d.%d' % sys.version_info[:2] != '$1')" 2>/dev/null; then
    echo "$python"
    break
  fi
done
