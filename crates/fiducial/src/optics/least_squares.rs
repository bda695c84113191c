//! Minimises by Levenberg-Marquardt for a few unknowns, on the stack.
//!
//! A [`Problem`] gives the normal equations at a point and the point after a step; [`minimise`] solves, damps
//! and compares. A [`Schedule`] defines the end, the damping and the handling of a step that does not improve.
//! A problem that needs Gauss-Newton only takes [`NormalEquations::step`] with no damping.

use nalgebra::{SMatrix, SVector};

/// The normal equations of `N` unknowns at one point, with the cost there and extra data.
#[derive(Copy, Clone, Debug)]
pub(crate) struct NormalEquations<const N: usize, E = ()> {
    /// Weighted sum of the outer products of the residuals' gradients; its lower half is read.
    pub(crate) matrix: SMatrix<f64, N, N>,
    /// Weighted sum of gradients times negative residuals: the downhill direction.
    pub(crate) right: SVector<f64, N>,
    pub(crate) cost: f64,
    /// Sums of the problem's own.
    pub(crate) extra: E,
}

impl<const N: usize, E> NormalEquations<N, E> {
    /// The step to the minimum of the quadratic model. The diagonal is increased by `damping` of itself and
    /// by `ridge`. `None` when the matrix is not positive definite.
    #[inline]
    pub(crate) fn step(&self, damping: f64, ridge: f64) -> Option<SVector<f64, N>> {
        let mut matrix = self.matrix;
        for i in 0..N {
            matrix[(i, i)] += damping * self.matrix[(i, i)] + ridge;
        }
        Some(matrix.cholesky()?.solve(&self.right))
    }
}

/// The influence of one residual.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Influence {
    /// Factor of its square in the normal equations.
    pub(crate) weight: f64,
    /// Its part of the cost.
    pub(crate) cost: f64,
}

/// Huber's loss: squares up to `limit`, straight lines beyond.
#[inline]
pub(crate) fn huber(residual: f64, limit: f64) -> Influence {
    let size = residual.abs();
    if size > limit {
        Influence { weight: limit / size, cost: limit * (2.0 * size - limit) }
    } else {
        Influence { weight: 1.0, cost: size * size }
    }
}

/// How the damping changes from step to step.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Damping {
    pub(crate) first: f64,
    /// After a good step it is a tenth, but no less than this.
    pub(crate) min: f64,
    /// After a bad step it is multiplied by this, ...
    pub(crate) increase: f64,
    /// ... and is no less than this.
    pub(crate) min_after_bad: f64,
    /// Above this the fit ends.
    pub(crate) max: f64,
    /// Added to the diagonal at any damping.
    pub(crate) ridge: f64,
}

/// When to stop and how to damp.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Schedule {
    pub(crate) max_steps: usize,
    pub(crate) damping: Damping,
    /// A step has settled when it lowers the cost by less than this fraction of it ...
    pub(crate) settled_ratio: f64,
    /// ... and this.
    pub(crate) settled_cost: f64,
    /// Without a solution of the equations, or a place after the step, the whole fit fails; else the damping
    /// grows.
    pub(crate) fails_without_step: bool,
    /// Where the place after a step has no equations, the whole fit fails; else the damping grows.
    pub(crate) fails_without_equations: bool,
}

/// The next action of a fit.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Next {
    Continue,
    /// The best place so far is the result.
    Stop,
    /// There is no result.
    Fail,
}

/// The decision on the point after a step.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Review {
    /// It is taken when it costs no more than the best one.
    Compare,
    /// It is taken at any cost: the costs are not comparable.
    Take,
    /// It is the result, with the equations of the place before it.
    Finish,
}

/// The problem that [`minimise`] solves.
pub(crate) trait Problem<const N: usize> {
    /// A place in the space of the unknowns.
    type Place: Copy;
    /// Extra data of the equations.
    type Extra;

    /// The equations at a place; `None` where there are none.
    fn linearised(&mut self, at: &Self::Place) -> Option<NormalEquations<N, Self::Extra>>;

    /// The place after a step; `None` where there is none.
    fn moved(&self, from: &Self::Place, step: &SVector<f64, N>) -> Option<Self::Place>;

    /// Called before each step, with the number of steps tried so far.
    #[inline]
    fn before_step(
        &mut self,
        _tried: usize,
        _best: &Self::Place,
        _equations: &NormalEquations<N, Self::Extra>,
    ) -> Next {
        Next::Continue
    }

    /// Called with each place that is stepped to, before its equations are made.
    #[inline]
    fn review(&mut self, _best: &Self::Place, _candidate: &mut Self::Place) -> Review {
        Review::Compare
    }

    /// Called after each step that was taken, with the number of steps tried before it. The equations may be
    /// built again.
    #[inline]
    fn after_step(
        &mut self,
        _tried: usize,
        has_settled: bool,
        _best: &Self::Place,
        _equations: &mut NormalEquations<N, Self::Extra>,
    ) -> Next {
        if has_settled { Next::Stop } else { Next::Continue }
    }
}

/// A place of least cost near the start.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Minimum<const N: usize, P, E> {
    pub(crate) place: P,
    pub(crate) equations: NormalEquations<N, E>,
}

/// The place of least cost that Levenberg-Marquardt steps lead to from `start`.
#[inline]
pub(crate) fn minimise<const N: usize, P: Problem<N>>(
    problem: &mut P,
    start: P::Place,
    schedule: &Schedule,
) -> Option<Minimum<N, P::Place, P::Extra>> {
    let Schedule { max_steps, damping: limits, .. } = *schedule;
    let equations = problem.linearised(&start)?;
    let mut best = Minimum { place: start, equations };
    let mut damping = limits.first;
    for tried in 0..max_steps {
        match problem.before_step(tried, &best.place, &best.equations) {
            Next::Continue => {}
            Next::Stop => break,
            Next::Fail => return None,
        }
        let step = best.equations.step(damping, limits.ridge);
        let candidate = step.and_then(|step| problem.moved(&best.place, &step));
        if candidate.is_none() && schedule.fails_without_step {
            return None;
        }
        let mut taken = None;
        if let Some(mut place) = candidate {
            let review = problem.review(&best.place, &mut place);
            if review == Review::Finish {
                return Some(Minimum { place, ..best });
            }
            let equations = problem.linearised(&place);
            if equations.is_none() && schedule.fails_without_equations {
                return None;
            }
            taken = equations
                .filter(|next| review == Review::Take || next.cost <= best.equations.cost)
                .map(|equations| Minimum { place, equations });
        }
        if let Some(next) = taken {
            let before = best.equations.cost;
            let has_settled = before - next.equations.cost
                < schedule.settled_ratio * before + schedule.settled_cost;
            best = next;
            damping = (damping * 0.1).max(limits.min);
            match problem.after_step(tried, has_settled, &best.place, &mut best.equations) {
                Next::Continue => {}
                Next::Stop => break,
                Next::Fail => return None,
            }
        } else {
            damping = (damping * limits.increase).max(limits.min_after_bad);
            if damping > limits.max {
                break;
            }
        }
    }
    Some(best)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A decaying exponential through samples of which one is far off.
    struct Decay<'a> {
        samples: &'a [[f64; 2]],
    }

    const SCHEDULE: Schedule = Schedule {
        max_steps: 40,
        damping: Damping {
            first: 1e-3,
            min: 1e-9,
            increase: 10.0,
            min_after_bad: 0.0,
            max: 1e9,
            ridge: 0.0,
        },
        settled_ratio: 1e-12,
        settled_cost: 0.0,
        fails_without_step: false,
        fails_without_equations: false,
    };

    impl Problem<2> for Decay<'_> {
        type Place = [f64; 2];
        type Extra = usize;

        fn linearised(&mut self, [height, rate]: &[f64; 2]) -> Option<NormalEquations<2, usize>> {
            let mut sums = NormalEquations {
                matrix: SMatrix::zeros(),
                right: SVector::zeros(),
                cost: 0.0,
                extra: 0,
            };
            for [t, value] in self.samples {
                let decay = (-rate * t).exp();
                let residual = value - height * decay;
                let Influence { weight, cost } = huber(residual, 0.01);
                let gradient = SVector::<f64, 2>::new(decay, -t * height * decay);
                sums.matrix += gradient * gradient.transpose() * weight;
                sums.right += gradient * (weight * residual);
                sums.cost += cost;
                sums.extra += usize::from(weight < 1.0);
            }
            sums.cost.is_finite().then_some(sums)
        }

        fn moved(&self, from: &[f64; 2], step: &SVector<f64, 2>) -> Option<[f64; 2]> {
            let rate = from[1] + step[1];
            (rate > 0.0).then_some([from[0] + step[0], rate])
        }
    }

    #[test]
    fn an_outlier_hardly_moves_the_fit() {
        let mut samples: Vec<_> =
            (0..20).map(|i| f64::from(i) * 0.1).map(|t| [t, 3.0 * (-1.5 * t).exp()]).collect();
        samples[7][1] += 1.0;
        let mut problem = Decay { samples: &samples };
        let found = minimise(&mut problem, [1.0, 0.3], &SCHEDULE).unwrap();
        assert!((found.place[0] - 3.0).abs() < 0.01, "{found:?}");
        assert!((found.place[1] - 1.5).abs() < 0.01, "{found:?}");
        assert_eq!(found.equations.extra, 1);
    }

    #[test]
    fn a_fit_without_a_step_fails_or_continues() {
        let samples = [[0.0, 1.0], [1.0, 10.0]];
        // The minimum is a negative rate, which this problem does not allow.
        let mut problem = Decay { samples: &samples };
        let strict = Schedule { fails_without_step: true, ..SCHEDULE };
        assert!(minimise(&mut problem, [1.0, 0.1], &strict).is_none());
        assert!(minimise(&mut problem, [1.0, 0.1], &SCHEDULE).is_some());
    }

    #[test]
    fn huber_is_smooth_at_its_limit() {
        let [below, above] = [2.0 - 1e-9, 2.0 + 1e-9].map(|residual| huber(-residual, 2.0));
        assert!(
            (below.cost - above.cost).abs() < 1e-7 && (below.weight - above.weight).abs() < 1e-8
        );
        assert_eq!(huber(4.0, 2.0), Influence { weight: 0.5, cost: 12.0 });
    }
}
