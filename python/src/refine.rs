//! Refinement of a splat on the photos of its capture.

use crate::capture::Capture;
use crate::error::to_python;
use crate::models::device;
use crate::splat::{Parameters, in_world, to_dict};
use crate::work::run;
use globalsplat::Error;
use globalsplat::refine::{RefineEvent, RefineOptions, RefineSession, SceneInit};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Refines `initial`, or a splat that starts from the photos, with `options` as JSON. `progress` is called with the number of steps and the most recent PSNR.
/// Returns the splat's parameters and the warnings.
#[pyfunction]
pub fn refine<'py>(
    py: Python<'py>,
    capture: &Capture,
    initial: Option<Parameters>,
    options: &str,
    cuda: Option<usize>,
    progress: Option<Py<PyAny>>,
) -> PyResult<(Bound<'py, PyDict>, Vec<String>)> {
    let initial = initial.map(Parameters::into_splat).transpose()?;
    let options: RefineOptions =
        serde_json::from_str(options).map_err(|error| to_python(Error::request(error.to_string())))?;
    let options = RefineOptions { device: device(cuda), ..options };
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
        let init = initial.as_ref().map_or(SceneInit::Photos, SceneInit::Splat);
        let mut session = RefineSession::load(&capture.0, &options, init, on_event)?;
        session.start()?;
        Ok(in_world(session.run()?.splat))
    });
    // An interrupted session may end with an error of its own.
    if let Some(raised) = raised {
        return Err(raised);
    }
    let mut splat = refined?;
    warnings.append(&mut splat.warnings);
    Ok((to_dict(py, splat)?, warnings))
}
