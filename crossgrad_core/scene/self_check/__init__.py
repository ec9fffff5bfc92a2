"""The check of a scene against itself: do points, poses and photos belong together?"""
