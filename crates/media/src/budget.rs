//! Limits the bytes of a reader, for formats whose parser may read a small damaged file for ever.

use std::io::{Error, Read, Result, Seek, SeekFrom};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Bytes that every seek costs, so that seeking for ever ends as well.
const SEEK_BYTES: u64 = 8;

/// Passes reads on until the budget is used up; then every read and seek fails.
#[derive(Debug)]
pub(crate) struct BudgetReader<R> {
    inner: R,
    left: Budget,
}

/// The bytes that may still be read.
#[derive(Clone, Debug)]
pub(crate) struct Budget(Arc<AtomicU64>);

impl Budget {
    /// A budget of `bytes`.
    pub(crate) fn new(bytes: u64) -> Self {
        Self(Arc::new(AtomicU64::new(bytes)))
    }

    /// From now on everything may be read.
    pub(crate) fn lift(&self) {
        self.0.store(u64::MAX, Ordering::Relaxed);
    }

    fn take(&self, bytes: u64) -> Result<()> {
        let spend = |left: u64| match left {
            u64::MAX => Some(left),
            left => left.checked_sub(bytes),
        };
        let spent = self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, spend);
        spent.map(drop).map_err(|_| Error::other("its structure leads in circles"))
    }
}

impl<R> BudgetReader<R> {
    /// A reader of `inner` with this budget.
    pub(crate) fn new(inner: R, left: Budget) -> Self {
        Self { inner, left }
    }
}

impl<R: Read> Read for BudgetReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize> {
        let count = self.inner.read(buffer)?;
        self.left.take(count as u64)?;
        Ok(count)
    }
}

impl<R: Seek> Seek for BudgetReader<R> {
    fn seek(&mut self, to: SeekFrom) -> Result<u64> {
        self.left.take(SEEK_BYTES)?;
        self.inner.seek(to)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    #[test]
    fn reading_ends_with_the_budget_until_it_is_lifted() {
        let budget = Budget::new(100);
        let mut reader = BudgetReader::new(Cursor::new([0; 64]), budget.clone());
        let mut bytes = [0; 64];
        reader.read_exact(&mut bytes).unwrap();
        reader.rewind().unwrap();
        assert!(reader.read_exact(&mut bytes).is_err());
        budget.lift();
        reader.rewind().unwrap();
        reader.read_exact(&mut bytes).unwrap();
    }
}
