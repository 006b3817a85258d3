@rem A COLMAP whose commands all fail.
@if "%1"=="help" (echo COLMAP 3.9 -- Structure-from-Motion) else (exit 1)
