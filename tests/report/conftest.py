"""What the tests of several pages share."""

from browser import browser as browser
