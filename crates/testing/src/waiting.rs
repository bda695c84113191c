//! Waiting for what another process or task does in its own time.

use std::time::Duration;

use anyhow::Context;
use tokio::time::{sleep, timeout};

/// How often it is asked.
const PERIOD: Duration = Duration::from_millis(20);

/// Waits until something holds, by asking every 20 ms.
///
/// # Errors
/// It does not hold within the patience; the error says `what` was waited for.
pub async fn until(
    what: &str,
    patience: Duration,
    mut holds: impl AsyncFnMut() -> bool,
) -> anyhow::Result<()> {
    let asked = async {
        while !holds().await {
            sleep(PERIOD).await;
        }
    };
    timeout(patience, asked).await.with_context(|| format!("waited {patience:?} until {what}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn it_asks_until_something_holds_and_says_what_does_not() {
        let mut asked = 0;
        let third = async || {
            asked += 1;
            asked == 3
        };
        until("it was asked thrice", Duration::from_secs(60), third).await.unwrap();
        assert_eq!(asked, 3);
        let never = until("it rains", Duration::from_millis(1), async || false).await;
        assert_eq!(never.unwrap_err().to_string(), "waited 1ms until it rains");
    }
}
