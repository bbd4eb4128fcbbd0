"""An answer as a page: the photograph with its matches, the best references beside it, the plan, and the figures.

Begin with `page.answer_page`; `mapless-server draw` makes pages of what `mapless localize --debug` has written.
"""
