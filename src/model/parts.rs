//! Profiling events of a forward pass: named spans, and the floating-point operations and bytes recorded in them.

use std::cell::RefCell;
use tch::Tensor;

/// Profiling event of a forward pass.
#[derive(Debug, Clone, Copy)]
pub enum Event {
    /// Start of a span. Spans don't nest: a span within another one reports no events of its own.
    Begins(&'static str),
    /// End of the current span.
    Ends,
    /// Work done in the current span.
    Flops {
        /// Number of floating-point operations of matrix products in the forward pass.
        flops: f64,
        /// Number of floating-point operations of matrix products in the backward pass; 0 if no gradient is needed.
        backward_flops: f64,
        /// Number of bytes of the input and output tensors.
        bytes: f64,
    },
}

struct Listener {
    tell: Box<dyn FnMut(Event)>,
    is_within: bool,
}

thread_local! {
    static LISTENER: RefCell<Option<Listener>> = const { RefCell::new(None) };
}

/// Runs `pass` and calls `listener` for every profiling event of this thread.
pub fn told<T>(listener: impl FnMut(Event) + 'static, pass: impl FnOnce() -> T) -> T {
    LISTENER.set(Some(Listener { tell: Box::new(listener), is_within: false }));
    let result = pass();
    LISTENER.set(None);
    result
}

/// Runs `work` as a span called `name`.
pub(crate) fn part<T>(name: &'static str, work: impl FnOnce() -> T) -> T {
    let begins = LISTENER.with_borrow_mut(|listener| match listener {
        Some(listener) if !listener.is_within => {
            listener.is_within = true;
            (listener.tell)(Event::Begins(name));
            true
        }
        _ => false,
    });
    let result = work();
    if begins {
        LISTENER.with_borrow_mut(|listener| {
            if let Some(listener) = listener {
                listener.is_within = false;
                (listener.tell)(Event::Ends);
            }
        });
    }
    result
}

/// Records work on `tensors`, the inputs and outputs: `flops` in the forward pass and `backward_flops` in the backward pass. A no-op outside of
/// spans.
pub(super) fn record_flops(flops: i64, backward_flops: i64, tensors: &[&Tensor]) {
    LISTENER.with_borrow_mut(|listener| {
        if let Some(listener) = listener.as_mut().filter(|listener| listener.is_within) {
            let bytes: usize = tensors.iter().map(|t| t.numel() * t.kind().elt_size_in_bytes()).sum();
            (listener.tell)(Event::Flops {
                flops: flops as f64,
                backward_flops: backward_flops as f64,
                bytes: bytes as f64,
            });
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::rc::Rc;
    use tch::{Device, Kind};

    #[test]
    fn a_part_within_another_is_none_of_its_own() {
        let said = Rc::new(RefCell::new(vec![]));
        let numbers = Tensor::zeros([3, 5], (Kind::BFloat16, Device::Cpu));
        let pass = || {
            record_flops(7, 0, &[&numbers]);
            part("outer", || part("inner", || record_flops(2, 3, &[&numbers, &numbers])));
            part("next", || 4)
        };
        let to = said.clone();
        assert_eq!(told(move |event| to.borrow_mut().push(format!("{event:?}")), pass), 4);
        let expected = [
            "Begins(\"outer\")",
            "Flops { flops: 2.0, backward_flops: 3.0, bytes: 60.0 }",
            "Ends",
            "Begins(\"next\")",
            "Ends",
        ];
        assert_eq!(*said.borrow(), expected);
        assert_eq!(part("unheard", || 5), 5);
        assert_eq!(said.borrow().len(), expected.len());
    }
}
