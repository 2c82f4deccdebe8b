"""`python -m sample_data SCENE FOLDER`."""

import sys

from sample_data.make import main

sys.exit(main())
