"""``python -m qfolio`` is the ``qfolio`` command."""

from qfolio.cli import main

main()
