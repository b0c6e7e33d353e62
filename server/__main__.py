"""`python -m server` is `nafir`."""

from server.cli.main import main

if __name__ == "__main__":
    main()
