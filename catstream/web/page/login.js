// The address that `catstream view` prints ends with #TOKEN: a browser does not send the part after #.
if (location.hash.length > 1) {
  document.querySelector("#token").value = location.hash.slice(1);
  history.replaceState(null, "", "/");
  document.querySelector("form").submit();
}
