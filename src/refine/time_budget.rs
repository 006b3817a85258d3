//! Clock of a session, which divides its time.

use super::options::Budget;
use std::time::{Duration, Instant};

/// Minimum time for the optimization, however long the start took.
const MIN_TIME: Duration = Duration::from_secs(1);
/// Maximum fraction of the time for computing depths, beyond the first `FEW_PHOTOS` photos.
const MAX_START_SHARE: f64 = 0.5;
/// Number of photos whose depths are computed regardless of the time budget.
const FEW_PHOTOS: usize = 2;
/// Maximum fraction of the time for scores during the optimization.
const MAX_SCORING_SHARE: f64 = 0.03;
/// Maximum fraction of the time for scoring the initial Gaussians on whole held-out views, and again for the final ones.
const MAX_WHOLE_SCORING_SHARE: f64 = 0.05;
/// Estimated time for writing the splat and ending the program: a constant, and the time per Gaussian.
const WRITING_TIME: Duration = Duration::from_millis(200);
const WRITING_TIME_PER_GAUSSIAN: Duration = Duration::from_micros(2);

/// Clock of a session that divides its budget.
#[derive(Debug)]
pub(super) struct TimeBudget {
    budget: Budget,
    clock: Instant,
    /// Time for work after the optimization.
    pub reserve: Duration,
    /// Time that scores took during the optimization.
    scoring: Duration,
    /// Time of the last of these scores; before the first, its expected time.
    pub last_scoring: Duration,
}

impl TimeBudget {
    pub fn new(budget: Budget, clock: Instant) -> Self {
        let none = Duration::ZERO;
        TimeBudget { budget, clock, reserve: none, scoring: none, last_scoring: none }
    }

    /// Returns the time since the clock began.
    pub fn elapsed(&self) -> Duration {
        self.clock.elapsed()
    }

    /// Returns the time since the clock began in seconds.
    pub fn seconds(&self) -> f64 {
        self.elapsed().as_secs_f64()
    }

    /// Reserves the time of writing a splat of `count` Gaussians.
    pub fn reserve_for_writing(&mut self, count: i64) {
        self.reserve += WRITING_TIME + WRITING_TIME_PER_GAUSSIAN * count as u32;
    }

    /// Returns `true` if the depths of `done` photos have to be enough.
    pub fn is_late_for_depths(&self, done: usize) -> bool {
        match self.budget {
            Budget::Steps(_) => false,
            Budget::Time(time) => done >= FEW_PHOTOS && self.elapsed() > time.mul_f64(MAX_START_SHARE),
        }
    }

    /// Returns a warning if reading the photos and the start left little or no time for the optimization.
    pub fn late_start_warning(&self) -> Option<String> {
        let Budget::Time(time) = self.budget else { return None };
        let elapsed = self.elapsed();
        (elapsed + self.reserve + MIN_TIME.min(time) > time).then(|| {
            let (time, elapsed) = (time.as_secs_f64(), elapsed.as_secs_f64());
            format!("{time:.0} s are too short here: reading the photos and the initialization took {elapsed:.1} s; few steps are left")
        })
    }

    /// Reserves the time of scoring initial and final Gaussians on held-out views, each of which takes `each`. Returns the interval between
    /// those of `count` views that there is time for.
    pub fn reserve_for_held_out(&mut self, each: Duration, count: usize) -> usize {
        let Budget::Time(time) = self.budget else { return 1 };
        let affordable = time.mul_f64(MAX_WHOLE_SCORING_SHARE);
        let every = (each * count as u32).div_duration_f64(affordable).ceil().max(1.) as usize;
        self.reserve += 2 * each * count.div_ceil(every) as u32;
        every
    }

    /// Returns `true` if another scoring keeps the total time of scoring below its maximum fraction of the time since the clock began.
    pub fn may_score(&self) -> bool {
        self.scoring + self.last_scoring <= self.elapsed().mul_f64(MAX_SCORING_SHARE)
    }

    /// Adds the time of a scoring during the optimization.
    pub fn add_scoring(&mut self, time: Duration) {
        self.last_scoring = time;
        self.scoring += time;
    }

    /// Returns the budget of an optimization that continues one of `optimized`, for which `earlier` was spent in all.
    pub fn remaining(&self, optimized: Duration, earlier: Duration) -> Budget {
        match self.budget {
            Budget::Time(time) => {
                let used = self.reserve + self.elapsed() + earlier;
                Budget::Time(optimized + time.saturating_sub(used).max(MIN_TIME.min(time)))
            }
            steps => steps,
        }
    }
}
