"""Coarse trials that fit nothing: they note what a plan asks for, and answer as they are told."""


class Noted:
    """``begun`` are pairs of name and overrides, ``tried`` tuples of an effect, its overrides and an option.

    ``answers`` say which effects pay, by name.
    """

    def __init__(self, answers):
        self.answers, self.begun, self.tried = answers, [], []

    def begin(self, name, overrides, *, change=False):
        self.begun.append((name, list(overrides), *["changed"] * change))

    def rival(self, effect, name, overrides, *, adds=False):
        self.tried.append((effect, list(overrides), adds))
        return self.answers[effect]

    def drop(self, effect, overrides, *, longer=1):
        self.tried.append((effect, list(overrides), longer))
        return self.answers[effect]
