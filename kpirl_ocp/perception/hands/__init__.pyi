from .landmarks import FINGER_TIPS, PALM, WRIST, Hand, find_hands, hands_are_installed

__all__ = ["FINGER_TIPS", "PALM", "WRIST", "Hand", "find_hands", "hands_are_installed"]
