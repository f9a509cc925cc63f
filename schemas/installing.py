"""How what is missing is installed, for sentences of `MissingDependency`: from the package index, or in a checkout."""

from __future__ import annotations

#: torch, MuJoCo, robosuite and what belongs to them.
INSTALL_CAPTURE = "pip install 'vla-attention[capture]', or 'make setup' in a checkout"
#: LIBERO without what it declares (see requirements-libero.txt, which has the same versions).
INSTALL_LIBERO = "pip install --no-deps hf-libero==0.1.4 bddl==1.0.1, or 'make setup' in a checkout"
