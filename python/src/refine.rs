//! Refinement of a splat on the photos of its capture.

use crate::capture::Capture;
use crate::error::to_python;
use crate::models::device;
use crate::splat::{Parameters, to_dict};
use crate::work::run;
use globalsplat::Error;
use globalsplat::data::PhotoSize;
use globalsplat::refine::{Budget, Initial, RefineConfig, RefineEvent, RefineOptions, RefineSession};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Options of a refinement, as the Python function's arguments of the same names.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Options {
    seconds: f64,
    steps: Option<u64>,
    gaussians: Option<usize>,
    views: Option<usize>,
    size: Option<u32>,
    seed: u64,
    antialiased: bool,
    correct_poses: bool,
    settings: Vec<String>,
    cuda: Option<usize>,
}

impl Options {
    fn into_refine_options(
        self,
        capture: &Capture,
        count: Option<usize>,
    ) -> globalsplat::Result<RefineOptions> {
        let time = Budget::from_seconds(self.seconds)
            .ok_or_else(|| Error::setting("seconds", self.seconds, "more than 0, up to a year"))?;
        let mut config = RefineConfig::with(&self.settings, count.is_some())?;
        config.antialiased |= self.antialiased;
        let options = RefineOptions {
            config,
            budget: self.steps.map_or(time, Budget::Steps),
            views: self.views,
            seed: self.seed,
            correct_poses: self.correct_poses,
            device: device(self.cuda),
            ..Default::default()
        };
        let gaussians = count.or(self.gaussians).unwrap_or_else(|| options.gaussians_for(&capture.0));
        let size = self.size.map_or(RefineOptions::size_for(gaussians), PhotoSize::Within);
        Ok(RefineOptions { gaussians, size, ..options })
    }
}

/// Refines `initial`, or a splat that starts from the photos. `progress` is called with the number of steps and the most recent PSNR.
/// Returns the splat's parameters and the warnings.
#[pyfunction]
pub fn refine<'py>(
    py: Python<'py>,
    capture: &Capture,
    initial: Option<Parameters>,
    options: Options,
    progress: Option<Py<PyAny>>,
) -> PyResult<(Bound<'py, PyDict>, Vec<String>)> {
    let initial = initial.map(Parameters::into_splat).transpose()?;
    let count = initial.as_ref().map(|splat| splat.len().max(1));
    let options = options.into_refine_options(capture, count).map_err(to_python)?;
    let (mut warnings, mut raised) = (vec![], None);
    let refined = run(py, || {
        let on_event = |event: RefineEvent| {
            if let RefineEvent::Warning(line) = event {
                warnings.push(line.to_string());
            }
            let reported = Python::attach(|py| {
                py.check_signals()?;
                match (&progress, event) {
                    (Some(progress), RefineEvent::Optimizing { steps, psnr }) => {
                        progress.call1(py, (steps, psnr)).map(|_| ())
                    }
                    _ => Ok(()),
                }
            });
            raised = raised.take().or(reported.err());
            raised.is_none()
        };
        let mut session = RefineSession::load(&capture.0, &options, on_event)?;
        session.start(initial.as_ref().map_or(Initial::Photos, Initial::Splat))?;
        Ok(session.run()?.splat)
    });
    // An interrupted session may end with an error of its own.
    if let Some(raised) = raised {
        return Err(raised);
    }
    let mut splat = refined?;
    warnings.append(&mut splat.warnings);
    Ok((to_dict(py, splat)?, warnings))
}
