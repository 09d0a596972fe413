#!/usr/bin/env bash
# The README's tour, as anyone can run it: docs/tour.sh PHOTOS, with turnscan on the PATH.
# PHOTOS holds step_num<K>.jpg, one frame every 1.125 degrees; a new folder `tour` is made here. Folders
# camera_calibration, laser_calibration and table beside it are what the second part calibrates from.
set -euo pipefail
PHOTOS=$(realpath "$1")
HERE=$(dirname "$(realpath "$0")")
mkdir tour && cd tour

run() {
  printf '$ %s\n' "$1"
  bash -c "$1" 2>&1
}
export PHOTOS
cp "$HERE/examples/desk-calibration.json" .
ls "$PHOTOS" | awk -F'[m.]' 'BEGIN {print "file,angle_deg"}
  {k = $(NF-1); print $0 "," (k < 2 ? 0 : 1.125 * (k - 2))}' > angles.csv

run 'turnscan init lab'
cd lab
run 'turnscan import images $PHOTOS --angles ../angles.csv --rig desk --label mouse'
run 'turnscan calibration add ../desk-calibration.json --certify'
run 'turnscan process'
run 'turnscan query "SELECT count(*) AS points, min(range_mm) AS nearest_mm, median(sigma_range_mm) AS sigma_mm FROM points WHERE x_mm*x_mm + y_mm*y_mm < 11000"'
run 'turnscan export mouse mouse.ply'
echo "-- again"
run 'turnscan process'
run "sed 's/166.04/166.54/' ../desk-calibration.json > ../moved.json"
run 'turnscan calibration add ../moved.json --certify'
run 'turnscan status'
run 'turnscan process'
run 'turnscan verify'

echo "-- a calibration of our own"
cd ..
export BOARDS=$PHOTOS/../camera_calibration STRIPES=$PHOTOS/../laser_calibration TABLE=$PHOTOS/../table
test -d "$BOARDS" || exit 0
run 'turnscan calibrate camera $BOARDS --pattern 8x6 --square-mm 40 --rig desk -o camera.json --picture camera.png'
run 'turnscan calibrate plane $STRIPES --pattern 8x6 --square-mm 40 -c camera.json -o plane.json --picture plane.png'
run 'turnscan calibrate axis "$TABLE/step*.jpg" --step-deg 22.5 --markers 4X4_50 --marker-side-mm 30 -c plane.json -o rig.json'
cd lab
run 'turnscan calibration add ../rig.json --certify'
run 'turnscan process --stale'
run 'turnscan compare c-d9e2 current mouse'
