"""Figures: the only part that draws.

Every function takes results and returns a matplotlib `Figure` of a printed page's width; `png` renders it, and
`figure_of` picks the figure that shows a result at a glance. Nothing is kept between calls, and the settings of a
caller's own matplotlib stay as they are. Long recordings are thinned to envelopes, so that a million samples cost as
much as a few thousand. `interactive` draws what a reader can zoom and ask, with Bokeh.

Neither matplotlib nor Bokeh is imported before a figure is asked for.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
