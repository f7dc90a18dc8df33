"""``python -m piezojax.sweep``; ``--help`` lists its options."""

from .cli.sweep import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.sweep")
